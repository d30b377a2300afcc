"""curate solve: weigh the labels."""

import typer

from pipelines.commands.options import (
    JsonOption,
    PolicyOption,
    RoundOption,
    WorkspaceOption,
    open_workspace,
)
from pipelines.commands.stages import run_round_command


def solve(
    policy: PolicyOption = None,
    round_number: RoundOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Weigh every label of a round under a policy; policies stand side by side.

    Policies: pspsl, spsl, uda, uda-cl, sess, 3dioumatch, st3d, hssda, threshold, baseline, or
    module:Class.

    Example: curate solve --policy spsl
    """
    run_round_command("solve", open_workspace(workspace), round_number, policy, as_json=as_json)


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(solve)
