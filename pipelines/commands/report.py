"""curate report: summarise a round on one page."""

import typer

from pipelines.commands.options import (
    ChartFormatOption,
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
    image_format: ChartFormatOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write a report of a round: one HTML file in the folder reports that works offline.

    It shows losses and lambda, priors, weights, labels by category and distance, other policies,
    changes since the previous round, images of uncertain, kept and changed labels, and the
    reliability curve if `curate audit` was run. With --format, each chart is also written as a file
    into a folder with the report's name.

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
