"""curate next: choose the unlabeled frames that a person should label next."""

from pathlib import Path
from typing import Annotated, Optional

import typer

from pipelines.commands.options import (
    JsonOption,
    LastRoundOption,
    PolicyOption,
    WorkspaceOption,
    complete,
    one_of,
    open_workspace,
)
from pipelines.registry import EDITORS
from pipelines.reports.terminal import print_json, print_line, print_table


def next(  # noqa: A001 - the name of the command
    frames: Annotated[int, typer.Option(min=1, help="Number of frames to choose.")] = 20,
    frame_cost: Annotated[
        float, typer.Option(help="Effort to open and check a frame, in boxes to draw.")
    ] = 5.0,
    export: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder to create for an editor, as `curate review export` does."),
    ] = None,
    editor: Annotated[
        str,
        typer.Option(
            help=f"Editor of --export: {one_of((*EDITORS.classes, 'module:Class'))}.",
            autocompletion=complete(EDITORS.classes),
        ),
    ] = "kitti",
    round_number: LastRoundOption = None,
    policy: PolicyOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Choose the unlabeled frames in which a person's labels would change most per box.

    What a person would change is expected from the stored score s, weight v and probability p of
    each label: its weight by p (1 - v) + (1 - p) v, and the teacher's squared error by p (1 - s)^2
    + (1 - p) s^2. p is that of the learned policy if it is stored, else the weight. Categories with
    few labels and new sequences count more, see docs/review.md. No model runs. After correction,
    import the folder with `curate review import`.

    Example: curate next --frames 20 --export to-label --editor cvat
    """
    from dataclasses import astuple

    from curate.errors import ConfigError
    from pipelines.engine.progress import Bar
    from pipelines.review.exporting import write_review
    from pipelines.review.next_frames import next_sheet, rank_frames

    chosen_editor = EDITORS.build(editor, offered={}, options={})
    if export is not None and (export.is_file() or (export.is_dir() and any(export.iterdir()))):
        raise ConfigError(f"{export}: already exists and may contain edits; specify a new folder")
    opened = open_workspace(workspace)
    found = rank_frames(opened, frames, round_number, policy, frame_cost)
    sheet = None
    if export is not None:
        sheet = next_sheet(opened, found, editor)
        write_review(opened, export, sheet, chosen_editor, Bar())
    if as_json:
        written = {"review": sheet.id, "folder": str(export)} if sheet else {}
        print_json({**vars(found), "frames": list(found.frames), **written})
        return
    meaning = "p of the learned policy" if found.by_probability else f"the weight of {found.policy}"
    print_table(
        ("rank", "frame", "sequence", "boxes", "change", "error", "doubtful", "gain", "reason"),
        [
            tuple(round(each, 3) if isinstance(each, float) else each for each in astuple(row))
            for row in found.frames
        ],
        title=f"{len(found.frames)} of {found.candidates} unlabeled frames, round {found.round}; "
        f"probability that a label is correct: {meaning}",
    )
    if sheet:
        print_line(
            f"review {sheet.id}: {sheet.asked} of {sheet.boxes} boxes to review, in {export}; see "
            "its README.txt"
        )
