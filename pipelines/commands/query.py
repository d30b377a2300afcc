"""curate query: run SQL on the database or an exported file."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from pipelines.commands.options import JsonOption, WorkspaceOption
from pipelines.reports.terminal import print_json_rows, print_line, print_table, print_tables

if TYPE_CHECKING:
    from sqlalchemy import URL

    from pipelines.queries.schema import Relation

FORMATS = ("table", "csv", "json")
AUDITED = ("score", "rho_det", "consistency", "probability")
"""Evidence that `curate audit` stores in the column policy, besides the policies."""
_SCHEMA = ("table", "kind", "column", "type", "unit", "key", "null", "meaning")


def query(
    sql: Annotated[
        Optional[str],  # noqa: UP045
        typer.Argument(help="A SELECT statement; with --schema, the table or view to describe."),
    ] = None,
    named: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Run a query that ships with curate; --list shows them."),
    ] = None,
    show_list: Annotated[
        bool, typer.Option("--list", help="List the queries that ship with curate.")
    ] = False,
    schema: Annotated[
        bool,
        typer.Option("--schema", help="List tables and views: columns, types, units, meaning."),
    ] = False,
    policy: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="With --named: only this policy's rows; default: all policies."),
    ] = None,
    round_number: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option("--round", min=0, help="With --named: only this round; default: all rounds."),
    ] = None,
    file: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Query an exported label file instead of the workspace's database."),
    ] = None,
    form: Annotated[str, typer.Option("--format", help="table, csv or json.")] = "table",
    as_csv: Annotated[bool, typer.Option("--csv", help="Short for --format csv.")] = False,
    limit: Annotated[
        int, typer.Option(min=1, help="Maximum number of rows of a table; csv and json print all.")
    ] = 50,
    seconds: Annotated[
        float, typer.Option(min=0.1, help="Time after which the query is stopped.")
    ] = 60.0,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Query the database with SQL; the connection is read-only.

    The view weighted_labels has a row per label and policy, with all evidence. On SQLite, curate
    adds the functions median(x), quantile(x, q), corr(x, y), stddev(x) and iou_bev(x1, y1, length1,
    width1, yaw1, x2, ...). Tables round fractions to four digits. In a terminal, a table that is
    too wide is shown as a block per row, and a long one in the pager (PAGER=cat switches it off).

    Example: curate query "SELECT frame, k, weight FROM weighted_labels WHERE weight > 0.5"
    """
    from curate.errors import ConfigError

    form = "json" if as_json else "csv" if as_csv else form
    if form not in FORMATS:
        raise ConfigError(f"--format {form}: use one of {', '.join(FORMATS)}")
    if (sql is not None and not schema) + (named is not None) + show_list + schema != 1:
        raise ConfigError("query: give one of a SELECT, --named NAME, --list or --schema")
    if named is None and (policy is not None or round_number is not None):
        raise ConfigError("query: --policy and --round go with --named; write WHERE in a SELECT")
    if schema:
        _print_schema(_schema(sql, file, workspace), form)
    elif show_list:
        _print(*_list(), form, None)
    else:
        from pipelines.queries.run_query import run_query

        url = _database(file, workspace)
        if named is not None:
            sql = _named(named, policy, round_number, url)
        _print(*run_query(url, sql or "", seconds), form, limit)


def _database(file: Path | None, workspace: Path | None) -> "URL":
    """Return the database to query.

    Raises:
        ConfigError: if there is no such file.
    """
    from sqlalchemy import URL

    from curate.errors import ConfigError
    from pipelines.workspace.location import database_url

    if file is None:
        return database_url(workspace)
    if not file.is_file():
        raise ConfigError(f"--file {file}: no such file; `curate export` writes one")
    return URL.create("sqlite", database=str(file))


def _named(name: str, policy: str | None, round_number: int | None, url: "URL") -> str:
    """Return the SQL of a named query, for a policy and a round.

    Raises:
        ConfigError: if a name is unknown, or the query has no column to select by.
    """
    from curate.errors import ConfigError
    from curate.spelling import did_you_mean
    from pipelines.queries.named_queries import find_query
    from pipelines.registry import POLICIES

    found = find_query(name)
    valid = (*POLICIES.classes, *AUDITED)
    if policy is not None and policy not in valid and ":" not in policy:
        raise ConfigError(
            f"--policy {policy}: unknown policy: use one of "
            f"{', '.join(valid)}, or module:Class{did_you_mean(policy, valid)}"
        )
    postgresql = url.get_backend_name() == "postgresql"
    return found.filtered(policy, round_number, postgresql=postgresql)


def _list() -> tuple[Sequence[str], Iterator[tuple[Any, ...]]]:
    from pipelines.queries.named_queries import named_queries

    return ("name", "exported file", "options", "result"), (
        (
            each.name,
            "yes" if each.exported else "no",
            " ".join(f"--{name}" for name in each.filters),
            each.description,
        )
        for each in named_queries().values()
    )


def _schema(name: str | None, file: Path | None, workspace: Path | None) -> "tuple[Relation, ...]":
    """Return all tables and views, or one; outside a workspace, those of a new workspace."""
    from curate.errors import WorkspaceError
    from pipelines.queries.schema import find_relation, read_schema, working_schema

    try:
        found = read_schema(_database(file, workspace), exported=file is not None)
    except WorkspaceError:
        if workspace is not None:
            raise
        found = working_schema()
    return found if name is None else (find_relation(found, name),)


def _print_schema(schema: "tuple[Relation, ...]", form: str) -> None:
    rows = {
        each: [
            (
                *(column.name, column.type, column.unit),
                *("yes" if flag else "" for flag in (column.key, column.optional)),
                column.meaning,
            )
            for column in each.columns
        ]
        for each in schema
    }
    if form == "table":
        print_tables(
            (
                (f"{each.name} ({each.kind}): {each.meaning}", _SCHEMA[2:], columns)
                for each, columns in rows.items()
            ),
            page=True,
        )
    else:
        flat = ((each.name, each.kind, *row) for each, columns in rows.items() for row in columns)
        _print(_SCHEMA, flat, form, None)


def _print(
    columns: Sequence[str], rows: Iterator[tuple[Any, ...]], form: str, limit: int | None
) -> None:
    import csv
    import sys
    from itertools import islice

    if form == "json":
        print_json_rows(dict(zip(columns, row, strict=True)) for row in rows)
    elif form == "csv":
        writer = csv.writer(sys.stdout)
        writer.writerow(columns)
        writer.writerows(rows)
    else:
        shown = list(islice(rows, limit))
        print_table(columns, shown, page=True)
        if not shown:
            typer.echo("no rows", err=True)
        if len(shown) == limit and next(rows, None) is not None:
            print_line(f"the first {limit} rows; more with --limit, all with --format csv or json")
