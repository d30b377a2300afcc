"""curate evaluate: compute KITTI average precision."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from pipelines.commands.options import (
    ExecutorOption,
    JsonOption,
    WorkersOption,
    WorkspaceOption,
    open_workspace,
)
from pipelines.reports.terminal import print_json, print_line, print_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from curate.datasets.kitti.labels import KittiObjects
    from curate.evaluation.kitti_ap import KittiEvaluation
    from pipelines.workspace.workspace import Workspace

OUTCOMES = {"tp": "detected", "fn": "missed", "ignored": "ignored"}


def evaluate(
    labels: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="Folder of KITTI label files to compare with --results; needs no workspace."
        ),
    ] = None,
    results: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder of KITTI result files, one per label file."),
    ] = None,
    frames: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="File that lists the frame ids to compare; default: all files of --labels."
        ),
    ] = None,
    round_number: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option("--round", min=1, help="Evaluate the stored val predictions of this round."),
    ] = None,
    checkpoint: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Checkpoint to run on the val frames; default: the newest."),
    ] = None,
    store: Annotated[
        bool,
        typer.Option("--store", help="Store AP and the outcome of every object in the database."),
    ] = False,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compute KITTI's average precision (image, aos, bev, 3d; R40 and R11) and recall.

    Without options the newest checkpoint is run on the val frames. With --labels and --results,
    every frame needs a file in both folders, an empty one if it has no objects; --frames takes a
    list such as ImageSets/val.txt. Detections with equal scores share one threshold. Without
    objects, or without detections, AP is 0.

    After --store, list the missed objects with: curate query "SELECT frame, category, x, y,
    occluded, iou FROM evaluation WHERE outcome = 'fn'". Outcomes are tp, fp, fn and ignored, by 3D
    IoU at the level hard, for detections of every score.

    Example: curate evaluate --labels data/label_2 --results out/results --json
    """
    from curate.errors import ConfigError

    if (labels is None) != (results is None):
        raise ConfigError("evaluate: --labels and --results go together")
    if frames is not None and labels is None:
        raise ConfigError("evaluate: --frames goes with --labels and --results")
    if labels is not None and results is not None:
        if store:
            raise ConfigError("evaluate: --store needs a workspace, not --labels and --results")
        from curate.evaluation.kitti_folders import read_folders

        _, truth, detections = read_folders(labels, results, frame_list=frames)
        found = _compare(truth, detections)
        notes = f"{results} on {len(truth)} frames"
    else:
        if round_number is not None and checkpoint is not None:
            raise ConfigError("evaluate: give --round or --checkpoint, not both")
        opened = open_workspace(workspace, executor, workers)
        found, notes = _evaluate_val(opened, round_number, checkpoint, store=store)
    if as_json:
        print_json(found.as_dict())
    else:
        print_line(notes)
        _print(found.as_dict())


def _evaluate_val(
    workspace: "Workspace", round_number: int | None, checkpoint: Path | None, *, store: bool
) -> "tuple[KittiEvaluation, str]":
    """Return the evaluation on the val frames, and a line that describes it."""
    from curate.errors import WorkspaceError
    from pipelines.assessment.evaluation import detect_val, stored_val, val_objects
    from pipelines.assessment.store import store_evaluation
    from pipelines.engine.progress import Bar
    from pipelines.engine.rounds import newest_checkpoint

    if round_number is not None:
        source = f"round {round_number}"
        detections = stored_val(workspace, round_number)
    else:
        path = checkpoint or newest_checkpoint(workspace)
        if not path.exists():
            raise WorkspaceError(f"--checkpoint {path}: no such file")
        source = workspace.relative(path)
        detections = detect_val(workspace, path, Bar())
    objects = val_objects(workspace, detections)
    found = _compare(*objects)
    notes = f"{source} on {len(detections)} val frames"
    if store:
        counts = store_evaluation(workspace, source, detections, objects, found)
        tail = ", ".join(f"{counts.get(name, 0)} {word}" for name, word in OUTCOMES.items())
        notes += f"; stored as source '{source}': {tail} objects"
    return found, notes


def _compare(
    labels: "Sequence[KittiObjects]", results: "Sequence[KittiObjects]"
) -> "KittiEvaluation":
    """Return the evaluation; print a message if its code must be compiled first."""
    from curate.evaluation import kitti_ap, kitti_matching
    from curate.geometry.compiled import is_compiled

    kitti_ap.check_frames(labels, results)  # report an error before the message below
    if not is_compiled(kitti_matching.count_at_thresholds):
        typer.echo("compiling the evaluation code (first use only, about ten seconds)", err=True)
    return kitti_ap.evaluate(labels, results)


def _print(figures: dict[str, Any]) -> None:
    """Print R40 and R11 side by side, a row per category and figure."""
    levels = ("easy", "mod.", "hard")
    columns = ["category", "figure", *(f"{kind} {d}" for kind in ("R40", "R11") for d in levels)]
    rows = []
    for category, by_figure in figures["AP_R40"].items():
        for figure, values in by_figure.items():
            other = figures["AP_R11"][category][figure]
            cells = [*(values or ["-"] * 3), *(other or ["-"] * 3)]
            rows.append((category, figure, *(_percent(cell) for cell in cells)))
        for overlap, shares in figures["recall_3d"][category].items():
            rows.append((category, f"recall 3d > {overlap}", *map(_percent, shares), "", "", ""))
    print_table(columns, rows, title="AP in percent")


def _percent(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)
