"""curate graph: show the stages as a DAG."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.commands.options import JsonOption, WorkspaceOption
from pipelines.reports.terminal import print_json, print_table

if TYPE_CHECKING:
    from pipelines.workspace.workspace import Workspace


def graph(
    mermaid: Annotated[
        bool, typer.Option("--mermaid", help="Print the graph as a Mermaid flowchart.")
    ] = False,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the stages that `curate run` runs in a round, and what each reads and writes.

    They depend on the configuration. Outside a workspace, all stages are shown.

    Example: curate graph
    """
    from pipelines.round import round_graph, run_graph

    opened = _workspace(workspace)
    found = round_graph() if opened is None else run_graph(opened)
    if as_json:
        fields = ("name", "command", "reads", "writes")
        print_json([{name: getattr(stage, name) for name in fields} for stage in found.stages])
    elif mermaid:
        typer.echo(found.as_mermaid())
    else:
        rows = ((", ".join(each.reads), each.name, ", ".join(each.writes)) for each in found.stages)
        print_table(("reads", "stage", "writes"), rows)


def _workspace(folder: Path | None) -> "Workspace | None":
    """Return the workspace; None if no folder is given and there is none here."""
    from curate.errors import WorkspaceError
    from pipelines.workspace.location import find_workspace
    from pipelines.workspace.workspace import Workspace

    try:
        root = find_workspace(folder)
    except WorkspaceError:
        if folder is not None:
            raise
        return None
    return Workspace.open(root)
