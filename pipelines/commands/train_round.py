"""curate train-round: a student from the exported labels."""

import typer

from pipelines.commands.options import (
    JsonOption,
    PolicyOption,
    RoundOption,
    ThreadsOption,
    WorkspaceOption,
)
from pipelines.commands.stages import run_round_command


def train_round(
    policy: PolicyOption = None,
    round_number: RoundOption = None,
    threads: ThreadsOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Train the student of a round on X_l and the weighted labels; it teaches the next round.

    A killed training continues from its last snapshot.

    Example: curate train-round
    """
    run_round_command(
        "train-round", workspace, round_number, policy, threads=threads, as_json=as_json
    )


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command(name="train-round")(train_round)
