"""curate report: a round on one page."""

from typing import Annotated, Optional

import typer

from pipelines.commands.options import (
    ChartFormatOption,
    JsonOption,
    PolicyOption,
    WorkspaceOption,
    open_workspace,
)
from pipelines.reports.terminal import print_json


def report(
    round_number: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option("--round", min=1, help="Round; default: the last that the policy weighted."),
    ] = None,
    policy: PolicyOption = None,
    image_format: ChartFormatOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write a round's report: one HTML file in reports/ that needs no network.

    Losses with lambda, priors, weights, labels by category and distance, other policies, what
    changed since the round before, doubted, kept and changed labels as pictures, and the
    reliability chart where `curate audit` has left its figures. With --format, each chart is also
    written as a file into a folder with the report's name.

    Example: curate report --round 2
    """
    from curate.viewing.chart_style import check_format
    from pipelines.reports.report import write_report

    kind = check_format(image_format) if image_format else None
    path, charts = write_report(open_workspace(workspace), round_number, policy, kind)
    if as_json:
        print_json({"report": str(path)} | ({"charts": list(map(str, charts))} if kind else {}))
    else:
        typer.echo(f"report: {path}")
        if charts:
            typer.echo(f"charts: {len(charts)} files in {charts[0].parent}")


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(report)
