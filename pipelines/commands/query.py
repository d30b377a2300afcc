"""curate query: SQL."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from pipelines.commands.options import JsonOption, WorkspaceOption
from pipelines.reports.terminal import print_json_rows, print_table

if TYPE_CHECKING:
    from sqlalchemy import URL

FORMATS = ("table", "csv", "json")


def query(
    sql: Annotated[Optional[str], typer.Argument(help="A SELECT.")] = None,  # noqa: UP045
    named: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Ask a question that ships with curate, see --list."),
    ] = None,
    show_list: Annotated[bool, typer.Option("--list", help="List these questions.")] = False,
    file: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Ask an exported label file, not the workspace's database."),
    ] = None,
    form: Annotated[str, typer.Option("--format", help="table, csv or json.")] = "table",
    as_csv: Annotated[bool, typer.Option("--csv", help="Short for --format csv.")] = False,
    limit: Annotated[
        int, typer.Option(min=1, help="Rows of the table; csv and json print all.")
    ] = 50,
    seconds: Annotated[
        float, typer.Option(min=0.1, help="After which the question is given up.")
    ] = 60.0,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Ask the database; the connection is read-only.

    Example: curate query "SELECT frame, k, weight FROM weighted_labels WHERE weight > 0.5"
    """
    from curate.errors import ConfigError
    from pipelines.queries.named_queries import find_query, named_queries
    from pipelines.queries.run_query import ask

    form = "json" if as_json else "csv" if as_csv else form
    if form not in FORMATS:
        raise ConfigError(f"--format {form}: use one of {', '.join(FORMATS)}")
    if (sql is not None) + (named is not None) + show_list != 1:
        raise ConfigError("query: give one of a SELECT, --named NAME or --list")
    if show_list:
        columns: Sequence[str] = ("name", "exported file", "answers")
        rows: Iterator[tuple[Any, ...]] = (
            (each.name, "yes" if each.exported else "no", each.description)
            for each in named_queries().values()
        )
        limit = len(named_queries())
    else:
        sql = find_query(named).sql if named is not None else sql or ""
        columns, rows = ask(_database(file, workspace), sql, seconds)
    _print(columns, rows, form, limit)


def _database(file: Path | None, workspace: Path | None) -> "URL":
    """The database that is asked.

    Raises:
        ConfigError: there is no such file.
    """
    from sqlalchemy import URL

    from curate.errors import ConfigError
    from pipelines.workspace.location import database_url

    if file is None:
        return database_url(workspace)
    if not file.is_file():
        raise ConfigError(f"--file {file}: no such file; `curate export` writes one")
    return URL.create("sqlite", database=str(file))


def _print(columns: Sequence[str], rows: Iterator[tuple[Any, ...]], form: str, limit: int) -> None:
    import csv
    import sys

    if form == "json":
        print_json_rows(dict(zip(columns, row, strict=True)) for row in rows)
    elif form == "csv":
        writer = csv.writer(sys.stdout)
        writer.writerow(columns)
        writer.writerows(rows)
    else:
        shown = [row for row, _ in zip(rows, range(limit), strict=False)]
        print_table(columns, shown)
        if len(shown) == limit and next(rows, None) is not None:
            typer.echo(f"the first {limit} rows; more with --limit, all with --format csv or json")


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(query)
