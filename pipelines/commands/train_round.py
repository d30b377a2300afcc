"""curate train-round: a student from the exported labels."""

from typing import Annotated, Optional

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
    command: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Your own trainer; default: train.command of curate.toml."),
    ] = None,
    labels_format: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Of its labels: sqlite, openpcdet, ...; default: train.labels_format."),
    ] = None,
    threads: ThreadsOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Train the student of a round on X_l and the weighted labels; it teaches the next round.

    A killed training continues from its last snapshot. With --command any trainer does it: in the
    command {labels}, {output}, {teacher}, {round} and {policy} are replaced, and CURATE_LABELS,
    CURATE_OUTPUT and so on are in its environment; no shell runs it. It writes one file, {output}.
    docs/training.md shows how v is made to count.

    Example: curate train-round --command "python train.py {labels} {output}"
    """
    changes = {"threads": threads, "command": command, "labels_format": labels_format}
    run_round_command(
        "train-round",
        workspace,
        round_number,
        policy,
        train={name: value for name, value in changes.items() if value is not None},
        as_json=as_json,
    )


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command(name="train-round")(train_round)
