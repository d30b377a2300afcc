"""curate graph: the DAG."""

from typing import Annotated

import typer

from pipelines.reports.terminal import print_table


def graph(
    mermaid: Annotated[bool, typer.Option(help="Print Mermaid source.")] = False,
) -> None:
    """Show the stages of a round: what each reads and writes.

    Example: curate graph
    """
    from pipelines.round import round_graph

    found = round_graph()
    if mermaid:
        typer.echo(found.as_mermaid())
    else:
        rows = ((", ".join(each.reads), each.name, ", ".join(each.writes)) for each in found.stages)
        print_table(("reads", "stage", "writes"), rows)


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(graph)
