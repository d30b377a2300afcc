"""curate train-round: train a student on the exported labels."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Optional

import typer

from pipelines.commands.options import (
    AllowEmptyOption,
    DryRunOption,
    JsonOption,
    PolicyOption,
    ProcessesOption,
    RoundOption,
    ThreadsOption,
    WorkspaceOption,
    complete,
    open_workspace,
    registered,
)
from pipelines.commands.stages import run_round_command
from pipelines.registry import EXPORTERS


def train_round(
    policy: PolicyOption = None,
    round_number: RoundOption = None,
    command: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="Command line of your own trainer; default: train.command of curate.toml."
        ),
    ] = None,
    labels_format: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help=f"Format of the labels that your trainer reads: {registered(EXPORTERS)}; default: "
            "train.labels_format of curate.toml.",
            autocompletion=complete(EXPORTERS.classes),
        ),
    ] = None,
    processes: ProcessesOption = None,
    threads: ThreadsOption = None,
    workspace: WorkspaceOption = None,
    allow_empty: AllowEmptyOption = False,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train the student of a round, which is the teacher of the next round.

    After an interruption the same command resumes from the last snapshot.

    --command runs your own trainer instead, in the folder of the workspace and without a shell.
    {labels}, {output}, {teacher}, {round} and {policy} in it are replaced, and are in its
    environment as CURATE_LABELS, CURATE_OUTPUT and so on. The trainer writes the file or folder
    {output}. After a student of the configured policy, the command is stored in curate.toml and
    also trains later rounds. docs/training.md shows how a trainer uses the weights.

    Example: curate train-round --command "python train.py {labels} {output}"
    """
    given = {"command": command, "labels_format": labels_format}
    changes = {name: value for name, value in given.items() if value is not None}
    opened = open_workspace(
        workspace, threads=threads, processes=processes, allow_empty=allow_empty
    )
    opened = opened.with_settings("train", **changes)
    run_round_command("train-round", opened, round_number, policy, as_json=as_json, dry_run=dry_run)
    if dry_run:
        return
    _store_settings(workspace, policy, changes)


def _store_settings(folder: Path | None, policy: str | None, changes: Mapping[str, str]) -> None:
    """Store the trainer's settings in curate.toml, so that later rounds use them."""
    from pipelines.workspace.config_file import change_settings
    from pipelines.workspace.location import CONFIG_NAME
    from pipelines.workspace.workspace import Workspace

    if not changes:
        return
    workspace = Workspace.open(folder)
    current = workspace.config.train.model_dump()
    new = {name: value for name, value in changes.items() if current[name] != value}
    if new and policy in (None, workspace.config.run.method):
        change_settings(workspace.root / CONFIG_NAME, "train", new)
        typer.echo(
            f"{CONFIG_NAME}: stored {' and '.join(new)} in [train] for later rounds", err=True
        )
