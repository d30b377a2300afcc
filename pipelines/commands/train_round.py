"""curate train-round: a student from the exported labels."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Optional

import typer

from pipelines.commands.options import (
    JsonOption,
    PolicyOption,
    RoundOption,
    ThreadsOption,
    WorkspaceOption,
    open_workspace,
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
    CURATE_OUTPUT and so on are in its environment; no shell runs it. It writes {output}, a
    file or a folder. docs/training.md shows how v is made to count. Once it has trained the student
    that teaches the next round, it is written into curate.toml, so that later rounds are trained
    with it too.

    Example: curate train-round --command "python train.py {labels} {output}"
    """
    given = {"command": command, "labels_format": labels_format}
    told = {name: value for name, value in given.items() if value is not None}
    opened = open_workspace(workspace, threads=threads).with_settings("train", **told)
    run_round_command("train-round", opened, round_number, policy, as_json=as_json)
    _remember(workspace, policy, told)


def _remember(folder: Path | None, policy: str | None, told: Mapping[str, str]) -> None:
    """Writes how the next teacher was trained into curate.toml, where later rounds look."""
    from pipelines.workspace.config_file import change_settings
    from pipelines.workspace.location import CONFIG_NAME
    from pipelines.workspace.workspace import Workspace

    if not told:
        return
    workspace = Workspace.open(folder)
    current = workspace.config.train.model_dump()
    new = {name: value for name, value in told.items() if current[name] != value}
    if new and policy in (None, workspace.config.run.method):
        change_settings(workspace.root / CONFIG_NAME, "train", new)
        typer.echo(
            f"{CONFIG_NAME}: [train] now says {' and '.join(new)}, for later rounds too", err=True
        )


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command(name="train-round")(train_round)
