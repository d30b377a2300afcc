"""curate predict: the teacher's boxes."""

from typing import Annotated

import typer

from pipelines.commands.options import (
    ExecutorOption,
    JsonOption,
    RoundOption,
    WorkersOption,
    WorkspaceOption,
)
from pipelines.commands.stages import run_frame_command


def predict(
    split: Annotated[str, typer.Option(help="unlabeled, val or labeled.")] = "unlabeled",
    round_number: RoundOption = None,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Run the teacher over frames and keep its boxes, low scores too.

    Example: curate predict --split unlabeled
    """
    run_frame_command(
        ("predict",), workspace, round_number, split, executor, workers, as_json=as_json
    )


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(predict)
