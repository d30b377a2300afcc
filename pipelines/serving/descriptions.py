"""Descriptions of databases, tables, columns and named queries for the pages, from the schema."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from db.evidence import Declaration
from pipelines.queries.named_queries import named_queries
from pipelines.queries.schema import (
    ColumnDescription,
    Relation,
    exported_schema,
    working_schema,
)

# Where the links in a column of the weighted labels lead.
_LINKS_TO = {"frame": "the page of the frame", "k": "the explanation of the weight"}


def working_database(declared: Sequence[Declaration] = ()) -> dict[str, Any]:
    """Return Datasette's metadata of a workspace's database.

    Args:
        declared: evidence sources with a table of their own.
    """
    tables = _tables(working_schema(declared))
    tables["alembic_version"] = {"hidden": True}
    tables["frame"]["label_column"] = "frame"
    return {
        "description": "Predictions with their evidence and weights, and the tasks that ran",
        "tables": tables,
        "queries": _queries(exported=False),
    }


def exported_file(path: Path) -> dict[str, Any]:
    """Return Datasette's metadata of an exported label file."""
    return {
        "description": "Exported weighted labels for a training",
        "tables": _tables(exported_schema(path)),
        "queries": _queries(exported=True),
    }


def _tables(schema: Iterable[Relation]) -> dict[str, Any]:
    """Return a description of each table and view, and of its columns with a meaning."""
    return {
        each.name: {
            "description": each.meaning,
            "columns": {
                column.name: _meaning(each, column) for column in each.columns if column.meaning
            },
        }
        for each in schema
    }


def _meaning(relation: Relation, column: ColumnDescription) -> str:
    """Return what a column means, with its unit and where its values link to."""
    unit = f" [{column.unit}]" if column.unit not in ("", "1") else ""
    shows_labels = relation.name in {"label", "weighted_labels"}
    target = _LINKS_TO.get(column.name) if shows_labels else None
    return column.meaning + unit + (f"; links to {target}" if target else "")


def _queries(*, exported: bool) -> dict[str, Any]:
    """Return the named queries that run on a database."""
    return {
        name: {"title": name, "description": f"{query.description}.", "sql": query.sql}
        for name, query in named_queries().items()
        if query.exported or not exported
    }
