"""curate run: run all stages of all rounds."""

from typing import Annotated, Optional

import typer

from pipelines.commands.dry_run import print_preview
from pipelines.commands.options import (
    DryRunOption,
    ExecutorOption,
    JsonOption,
    WorkersOption,
    WorkspaceOption,
    complete,
    end,
    open_workspace,
    registered,
)
from pipelines.registry import POLICIES
from pipelines.reports.terminal import print_report


def run(
    rounds: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="Number of rounds; default: run.rounds of curate.toml."),
    ] = None,
    method: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help=f"Method, see docs/methods.md: {registered(POLICIES)}; default: run.method of "
            "curate.toml.",
            autocompletion=complete(POLICIES.classes),
        ),
    ] = None,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run every stage of every round that is not up to date.

    With an external detector and without train.command, there is one round, and it ends with the
    export.

    Example: curate run --rounds 3 --method pspsl
    """
    from dataclasses import replace

    from pipelines.category_names import check_names
    from pipelines.engine.preview import preview_all
    from pipelines.engine.progress import Bar
    from pipelines.engine.schedule import check_stages, run_all
    from pipelines.round import graph_of
    from pipelines.stages.methods import with_method

    opened = open_workspace(workspace, executor, workers)
    if method is not None:
        opened = replace(opened, config=with_method(opened.config, method))
    check_names(opened)
    if dry_run:
        graph = graph_of(opened)
        check_stages(opened, graph, opened.config.run.method)
        print_preview(preview_all(opened, graph, rounds), as_json=as_json)
        return
    reports = []
    for report in run_all(opened, graph_of(opened), rounds, Bar()):
        reports.append(report)
        if not as_json:
            print_report(report)
    end(reports, as_json=as_json)
