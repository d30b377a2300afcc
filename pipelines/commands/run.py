"""curate run: the whole DAG."""

from typing import Annotated, Optional

import typer

from pipelines.commands.options import (
    ExecutorOption,
    JsonOption,
    WorkersOption,
    WorkspaceOption,
    end,
    open_workspace,
    print_report,
)


def run(
    rounds: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="E; default: run.rounds of curate.toml."),
    ] = None,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Bring every stage of every round up to date; what is up to date is not done again.

    With a detector that you bring, there is one round and it ends with the export.

    Example: curate run --rounds 3
    """
    from pipelines.progress import Bar
    from pipelines.schedule import run_all

    opened = open_workspace(workspace, executor, workers)
    reports = []
    for report in run_all(opened, rounds, Bar()):
        reports.append(report)
        if not as_json:
            print_report(report)
    end(reports, as_json=as_json)


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(run)
