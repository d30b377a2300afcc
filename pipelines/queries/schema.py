"""The tables and views that queries read, with type, unit and meaning of every column.

Tables are described by the models, evidence by what its sources declare. `curate query --schema`,
the page docs/schema.md and `curate serve` show this description.
"""

import inspect
import json
import re
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sqlalchemy import URL

from curate.errors import ConfigError, DatabaseError, one_line
from curate.exporters.columns import WEIGHTED_LABELS
from curate.priors.base import Column
from curate.spelling import did_you_mean
from db.evidence import OWN_TABLES, Declaration, evidence_table, label_columns
from db.models import Base
from db.views import VIEW_COLUMNS
from pipelines.queries.run_query import run_query

_VIEWS = {
    "weighted_labels": "Every label of an unlabeled frame with its evidence, a row per policy.",
    "evaluation": (
        "Outcome of every object and detection of val frames; `curate evaluate --store` fills it."
    ),
    "failed_frames": "Frames that a stage could not process, with the error.",
}
_EXPORTED = {
    "weighted_labels": _VIEWS["weighted_labels"],
    "meta": "Origin of the file: data set, categories, round, policy, code version.",
    "frame": "The labeled and unlabeled frames, with the paths of their files below meta.root.",
    "ground_truth": "Ground truth of the labeled frames.",
    "label": "The weighted labels; query them through the view weighted_labels.",
}
_EXPORTED_COLUMNS = {
    "split": "labeled | unlabeled",
    "frame": "frame id",
    "key": "name of an entry",
    "value": "value of the entry, as text",
    "points": "path of the point cloud",
    "image": "path of the image",
    "calibration": "path of the calibration",
}
_TYPES = {"int32": "INTEGER", "int64": "BIGINT", "float64": "FLOAT", "name": "TEXT"}
# A column of an exported file's table of labels: its name, and the comment with its meaning.
_COLUMN_NOTE = re.compile(r"^\s*(\w+) [A-Z]+.*?-- (.*?)(?: \[(.*)\])?$", re.MULTILINE)


@dataclass(frozen=True)
class ColumnDescription:
    """A column of a table or view.

    Attributes:
        name: its name.
        type: its SQL type.
        unit: "m", "rad", "px", "s", "%", "1" for a number without unit, "" for other values.
        meaning: in a few words.
        key: whether it belongs to the primary key.
        optional: whether it may be null.
    """

    name: str
    type: str
    unit: str
    meaning: str
    key: bool = False
    optional: bool = False


@dataclass(frozen=True)
class Relation:
    """A table or view.

    Attributes:
        name: its name.
        kind: "table" or "view".
        meaning: in one or more sentences.
        columns: in their order.
    """

    name: str
    kind: str
    meaning: str
    columns: tuple[ColumnDescription, ...]


def working_schema(declared: Sequence[Declaration] = ()) -> tuple[Relation, ...]:
    """Return the views and tables of a workspace's database.

    Args:
        declared: evidence sources with a table of their own.
    """
    tables = {model.__tablename__: _of_model(model) for model in Base.__subclasses__()}
    views = [_view("weighted_labels", map(_of_declared, label_columns(declared)))]
    for name, sources in VIEW_COLUMNS.items():
        pairs = (source.split(".") for source in sources)
        views.append(_view(name, (_column(tables[table], column) for table, column in pairs)))
    others = [each for each in declared if each.name not in OWN_TABLES]
    return (*views, *tables.values(), *map(_of_source, others))


def exported_schema(path: Path) -> tuple[Relation, ...]:
    """Return the tables and the view of an exported label file, as the file has them.

    Raises:
        DatabaseError: if the file is not a label file.
    """
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as opened:
            notes = _notes(opened)
            relations = [
                Relation(
                    name,
                    kind,
                    _EXPORTED[name],
                    tuple(
                        _of_file(row, notes | _fixed_columns(name))
                        for row in opened.execute(f"PRAGMA table_info({name})")
                    ),
                )
                for kind, name in opened.execute(
                    "SELECT type, name FROM sqlite_master WHERE type IN ('view', 'table')"
                )
                if name in _EXPORTED
            ]
    except sqlite3.Error as error:
        raise DatabaseError(f"{path}: {one_line(error)}; specify a label file of curate") from error
    return tuple(sorted(relations, key=lambda each: list(_EXPORTED).index(each.name)))


def read_schema(url: URL, *, exported: bool) -> tuple[Relation, ...]:
    """Return the tables and views of a database, with those of its evidence sources.

    Args:
        url: of the database.
        exported: whether it is an exported label file.

    Raises:
        DatabaseError: if it cannot be opened.
    """
    if exported:
        return exported_schema(Path(str(url.database)))
    query = "SELECT name, source, columns, rho_column FROM evidence_source ORDER BY name"
    try:
        _, rows = run_query(url, query)
    except ConfigError:  # a database of an older version of curate; the next command migrates it
        rows = iter(())
    return working_schema(
        tuple(
            Declaration(name, source, tuple(Column(**each) for each in json.loads(columns)), rho)
            for name, source, columns, rho in rows
        )
    )


def find_relation(schema: Iterable[Relation], name: str) -> Relation:
    """Return the table or view of that name.

    Raises:
        ConfigError: if the name is unknown.
    """
    by_name = {relation.name: relation for relation in schema}
    if name not in by_name:
        raise ConfigError(
            f"query --schema: no table or view is named '{name}': "
            f"use one of {', '.join(by_name)}{did_you_mean(name, by_name)}"
        )
    return by_name[name]


def _of_model(model: type[Base]) -> Relation:
    columns = tuple(
        ColumnDescription(
            column.name,
            str(column.type),
            column.info.get("unit", ""),
            column.doc or column.comment or "",
            column.primary_key,
            bool(column.nullable),
        )
        for column in Base.metadata.tables[model.__tablename__].columns
    )
    meaning = " ".join((inspect.getdoc(model) or "").split())
    return Relation(model.__tablename__, "table", meaning, columns)


def _model(name: str) -> type[Base]:
    return next(model for model in Base.__subclasses__() if model.__tablename__ == name)


def _of_declared(column: Column) -> ColumnDescription:
    return ColumnDescription(
        column.name, _TYPES[column.kind], column.unit, column.meaning, optional=column.optional
    )


def _of_source(source: Declaration) -> Relation:
    """Return the table of an evidence source: the key of the label, then what it declares."""
    declared = {column.name: _of_declared(column) for column in source.columns}
    key = {column.name: column for column in _of_model(_model("point_prior")).columns if column.key}
    names = (column.name for column in evidence_table(source).columns)
    columns = tuple((declared | key)[name] for name in names)
    return Relation(source.table, "table", f"Evidence of the source '{source.name}'.", columns)


def _view(name: str, columns: Iterable[ColumnDescription]) -> Relation:
    return Relation(name, "view", _VIEWS[name], tuple(columns))


def _column(relation: Relation, name: str) -> ColumnDescription:
    """Return a table's column as part of a view: not a key, and null if no row was joined."""
    [found] = (column for column in relation.columns if column.name == name)
    joined = relation.name == "ground_truth"
    return replace(found, key=False, optional=found.optional or joined)


def _notes(opened: sqlite3.Connection) -> dict[str, tuple[str, str]]:
    """Return meaning and unit of each column of the labels, from comments in the file's schema."""
    query = "SELECT sql FROM sqlite_master WHERE name = 'label'"
    row = opened.execute(query).fetchone()
    return {
        name: (meaning, unit or "")
        for name, meaning, unit in _COLUMN_NOTE.findall(row[0] if row else "")
    }


def _fixed_columns(table: str) -> dict[str, tuple[str, str]]:
    """Return meaning and unit of the columns that every label file has in a table or view."""
    if table in {"meta", "frame"}:
        return {name: (meaning, "") for name, meaning in _EXPORTED_COLUMNS.items()}
    columns = (*_of_model(_model("ground_truth")).columns, *map(_of_declared, WEIGHTED_LABELS))
    return {column.name: (column.meaning, column.unit) for column in columns}


def _of_file(row: tuple[Any, ...], described: dict[str, tuple[str, str]]) -> ColumnDescription:
    _, name, kind, required, _, key = row
    meaning, unit = described.get(name, ("", ""))
    return ColumnDescription(name, kind, unit, meaning, bool(key), not required)
