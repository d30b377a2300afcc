"""curate graph: show the stages as a DAG."""

from typing import Annotated

import typer

from pipelines.commands.options import JsonOption
from pipelines.reports.terminal import print_json, print_table


def graph(
    mermaid: Annotated[
        bool, typer.Option("--mermaid", help="Print the graph as a Mermaid flowchart.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Show the stages of a round and what each reads and writes.

    Example: curate graph
    """
    from pipelines.round import round_graph

    found = round_graph()
    if as_json:
        fields = ("name", "command", "reads", "writes")
        print_json([{name: getattr(stage, name) for name in fields} for stage in found.stages])
    elif mermaid:
        typer.echo(found.as_mermaid())
    else:
        rows = ((", ".join(each.reads), each.name, ", ".join(each.writes)) for each in found.stages)
        print_table(("reads", "stage", "writes"), rows)
