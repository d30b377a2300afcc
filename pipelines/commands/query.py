"""curate query: SQL."""

from typing import Annotated

import typer

from pipelines.commands.options import JsonOption, WorkspaceOption, print_json, print_table


def query(
    sql: Annotated[str, typer.Argument(help="A SELECT.")],
    as_csv: Annotated[bool, typer.Option("--csv", help="Print CSV.")] = False,
    limit: Annotated[
        int, typer.Option(min=1, help="Rows of the table; --json and --csv print all.")
    ] = 50,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Ask the database; the connection is read-only.

    Example: curate query "SELECT frame, k, weight FROM weighted_labels WHERE weight > 0.5"
    """
    import csv
    import sys

    from pipelines.asking import ask
    from pipelines.workspace import database_url

    columns, rows = ask(database_url(workspace), sql)
    if as_json:
        print_json([dict(zip(columns, row, strict=True)) for row in rows])
    elif as_csv:
        csv.writer(sys.stdout).writerows([columns, *rows])
    else:
        shown = [row for row, _ in zip(rows, range(limit), strict=False)]
        print_table(columns, shown)
        if len(shown) == limit and next(rows, None) is not None:
            typer.echo(f"the first {limit} rows; more with --limit, all with --json or --csv")


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(query)
