"""curate report: a round on one page."""

from typing import Annotated, Optional

import typer

from pipelines.commands.options import JsonOption, PolicyOption, WorkspaceOption, open_workspace
from pipelines.reports.terminal import print_json


def report(
    round_number: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option("--round", min=1, help="Round; default: the last that the policy weighted."),
    ] = None,
    policy: PolicyOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write a round's report: one HTML file in reports/ that needs no network.

    Losses with lambda, priors, weights, labels by category and distance, other policies, what
    changed since the round before, doubted, kept and changed labels as pictures, and the
    reliability curve where `curate audit` has left one.

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
