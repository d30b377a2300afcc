"""curate graph: the DAG."""

from typing import Annotated

import typer


def graph(
    mermaid: Annotated[bool, typer.Option(help="Print Mermaid source.")] = False,
) -> None:
    """Show the stages of a round: what each reads and writes.

    Example: curate graph
    """
    from pipelines.engine.graph import as_mermaid, as_text

    typer.echo(as_mermaid() if mermaid else as_text())


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(graph)
