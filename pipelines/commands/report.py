"""curate report: a round on one page."""

import typer

from pipelines.commands.options import (
    JsonOption,
    LastRoundOption,
    PolicyOption,
    WorkspaceOption,
    open_workspace,
)
from pipelines.reports.terminal import print_json


def report(
    round_number: LastRoundOption = None,
    policy: PolicyOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write a report of a round: one HTML file in the folder reports that works offline.

    It shows losses and lambda, priors, weights, labels by category and distance, other policies,
    changes since the previous round, images of uncertain, kept and changed labels, and the
    reliability curve if `curate audit` was run.

    Example: curate report --round 2
    """
    from pipelines.reports.report import write_report

    path = write_report(open_workspace(workspace), round_number, policy)
    if as_json:
        print_json({"report": str(path)})
    else:
        typer.echo(f"report: {path}")


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(report)
