"""curate graph: the DAG."""

from typing import Annotated

import typer


def graph(
    mermaid: Annotated[
        bool, typer.Option("--mermaid", help="Print it as a Mermaid flowchart.")
    ] = False,
) -> None:
    """Show the stages of a round, and what each reads and writes.

    Example: curate graph
    """
    from pipelines.round import round_graph

    found = round_graph()
    typer.echo(found.as_mermaid() if mermaid else found.as_text())


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(graph)
