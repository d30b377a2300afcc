"""curate augment: write augmented copies of frames for a detector that runs elsewhere."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from pipelines.commands.options import (
    DryRunOption,
    ExecutorOption,
    JsonOption,
    RoundOption,
    SplitOption,
    WorkersOption,
    WorkspaceOption,
    open_workspace,
)
from pipelines.reports.terminal import print_json, print_line


def augment(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="Folder to write to; {round} stands for the number of the round, {split} for the "
            "split.",
        ),
    ],
    split: SplitOption = "unlabeled",
    round_number: RoundOption = None,
    shard: Annotated[
        str,
        typer.Option(
            "--shard",
            metavar="K/N",
            help="Write only the K-th of N parts, such as 3/16, for several machines.",
        ),
    ] = "1/1",
    camera_view: Annotated[
        bool,
        typer.Option(
            "--camera-view",
            help="Write only the points that a camera sees, for detectors that do not crop.",
        ),
    ] = False,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write augmented copies of frames, for a detector that runs elsewhere.

    Each OUT/view-N is a data set with one copy of each frame. Finished copies are kept.

    Example: curate augment copies
    """
    from curate.errors import ConfigError, FramesFailed
    from pipelines.assembly import check_executor
    from pipelines.engine.progress import Bar
    from pipelines.engine.rounds import choose_round
    from pipelines.stages.augment import Shard, plan, write
    from pipelines.workspace.splits import SPLITS

    opened = open_workspace(workspace, executor, workers)
    if split not in SPLITS:
        raise ConfigError(f"--split {split}: use one of {', '.join(SPLITS)}")
    check_executor(opened.config)
    number, _ = choose_round(opened, round_number, None)
    part = Shard.parse(shard)
    planned = plan(opened, folder, split, number, part, camera_view=camera_view)
    views = planned.manifest.drawn.views
    size = f"about {planned.written_bytes / 1e6:.0f} MB"
    if dry_run:
        if as_json:
            print_json(
                {
                    "folder": planned.folder,
                    "round": number,
                    "split": split,
                    "views": views,
                    "frames": len(planned.frames),
                    "waiting": len(planned.missing),
                    "bytes": planned.written_bytes,
                    "free_bytes": planned.free_bytes,
                }
            )
            return
        print_line(
            f"Would write copies of {len(planned.missing)} of {len(planned.frames)} {split} frames "
            f"(views: {views}), {size}, to {planned.folder}. Nothing was done."
        )
        return
    if not as_json and planned.missing:
        print_line(
            f"Round {number}: copies of {len(planned.missing)} {split} frames (views: {views}), "
            f"{size}; {planned.free_bytes / 1e9:.1f} GB are free."
        )
    result = write(opened, planned, Bar())
    setting = opened.relative(folder)
    if as_json:
        print_json({**vars(result), "augmented": setting})
    else:
        print_line(f"{result.written} frames written, {result.kept} kept.")
        for name, error in result.errors[:10]:
            print_line(f"failed: {error if name in error else f'{name}: {error}'}", indent=4)
        _print_next(result.views, result.kind, setting)
    if result.errors:
        raise FramesFailed(
            f"{len(result.errors)} frames have no copies; fix their files and rerun, finished "
            "copies are kept"
        )


def _print_next(views: Sequence[str], kind: str, folder: str) -> None:
    """Print where the results of the copies belong, and the setting that reads them."""
    from curate.files.toml_text import toml

    print_line(
        f"Run the detector on {' and '.join(views)} (data set of kind {kind}), and put its results "
        "into the same folder: results/, result.pkl, results.json or results.csv."
    )
    print_line(f"Then set in [detector] of curate.toml: augmented = {toml(folder)}")
