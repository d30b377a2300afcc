"""curate solve: compute the weights of labels."""

from typing import Annotated, Optional

import typer

from pipelines.commands.options import (
    DryRunOption,
    JsonOption,
    RoundOption,
    WorkspaceOption,
    complete,
    open_workspace,
    registered,
)
from pipelines.commands.stages import run_round_command
from pipelines.registry import POLICIES


def solve(
    policy: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help=f"Policy: {registered(POLICIES)}; default: run.method of curate.toml.",
            autocompletion=complete(POLICIES.classes),
        ),
    ] = None,
    round_number: RoundOption = None,
    workspace: WorkspaceOption = None,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compute the weight of every label of a round under a policy.

    The weights of several policies are stored side by side. docs/methods.md describes the policies.

    Example: curate solve --policy spsl
    """
    run_round_command(
        "solve", open_workspace(workspace), round_number, policy, as_json=as_json, dry_run=dry_run
    )
