"""curate evaluate: KITTI average precision."""

from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from pipelines.commands.options import (
    ExecutorOption,
    JsonOption,
    WorkersOption,
    WorkspaceOption,
    open_workspace,
    print_json,
    print_table,
)


def evaluate(
    labels: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder of KITTI label files, with --results; needs no workspace."),
    ] = None,
    results: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder of KITTI result files, one per label file."),
    ] = None,
    round_number: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option("--round", min=1, help="The round's stored val predictions."),
    ] = None,
    checkpoint: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Run this checkpoint on the val frames; default: the newest."),
    ] = None,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Evaluate as the KITTI benchmark does: image, aos, bev and 3d AP, R40 and R11, and recall.

    Example: curate evaluate --labels data/label_2 --results out/results --json
    """
    from curate.errors import ConfigError

    if (labels is None) != (results is None):
        raise ConfigError("evaluate: --labels and --results go together")
    if labels is not None and results is not None:
        from curate.evaluation.kitti_ap import evaluate as compare
        from curate.evaluation.kitti_folders import read_folders

        _, truth, answers = read_folders(labels, results)
        found = compare(truth, answers)
    else:
        from pipelines.evaluation import evaluate_checkpoint, evaluate_round
        from pipelines.progress import Bar
        from pipelines.rounds import newest_checkpoint

        opened = open_workspace(workspace, executor, workers)
        if round_number is not None:
            found = evaluate_round(opened, round_number)
        else:
            path = checkpoint or newest_checkpoint(opened)
            found = evaluate_checkpoint(opened, path, Bar())
            if not as_json:
                typer.echo(f"{path} on {len(opened.frames('val'))} val frames")
    if as_json:
        print_json(found.as_dict())
    else:
        _print(found.as_dict())


def _print(figures: dict[str, Any]) -> None:
    """R40 and R11 side by side, a row per category and figure."""
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


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(evaluate)
