"""curate score: ask the priors."""

from typing import Annotated, Optional

import typer

from pipelines.commands.options import (
    ExecutorOption,
    JsonOption,
    RoundOption,
    WorkersOption,
    WorkspaceOption,
)
from pipelines.commands.stages import run_frame_command


def score(
    prior: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="points or semantic; default: run.priors of curate.toml."),
    ] = None,
    split: Annotated[str, typer.Option(help="unlabeled, val or labeled.")] = "unlabeled",
    round_number: RoundOption = None,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Ask the priors: LiDAR points in each box, segmentation in its rectangle.

    The equations are 8 and 9 of the paper.

    Example: curate score --prior points
    """
    stages = None if prior is None else (prior,)
    run_frame_command(stages, workspace, round_number, split, executor, workers, as_json=as_json)


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(score)
