"""curate pretrain: w_0 on X_l."""

import typer

from pipelines.commands.options import (
    JsonOption,
    ThreadsOption,
    WorkspaceOption,
    end,
    open_workspace,
    print_report,
)


def pretrain(
    threads: ThreadsOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Train the first teacher on the labeled frames alone.

    Example: curate pretrain
    """
    from pipelines.engine.progress import Bar
    from pipelines.stages.pretrain import pretrain as run

    report = run(open_workspace(workspace, threads=threads), Bar())
    if not as_json:
        print_report(report)
    end([report], as_json=as_json)


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(pretrain)
