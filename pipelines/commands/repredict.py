"""curate repredict: the teacher's answers for augmented copies."""

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


def repredict(
    split: Annotated[str, typer.Option(help="unlabeled, val or labeled.")] = "unlabeled",
    round_number: RoundOption = None,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Run the teacher over augmented copies, map its boxes back, measure the consistency loss.

    Example: curate repredict
    """
    run_frame_command(
        ("repredict",), workspace, round_number, split, executor, workers, as_json=as_json
    )


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(repredict)
