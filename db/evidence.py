"""Tables of evidence sources, created from the columns that the sources declare.

`point_prior` and `semantic_prior` are tables of the schema. Any other source has a table
`prior_NAME`, which is created when the source is first used, and a row in `evidence_source` with
its declaration. From these rows the view `weighted_labels` gets its columns after the core ones. A
column of a table of the schema that only some workspaces use, such as the camera of the semantic
prior or the probability of a weight, is declared in the same way.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sqlalchemy import (
    BigInteger,
    Column,
    Connection,
    Float,
    ForeignKeyConstraint,
    Integer,
    MetaData,
    Table,
    Text,
    select,
)
from sqlalchemy.schema import CreateTable, DropTable
from sqlalchemy.types import TypeEngine

from curate.exporters.columns import WEIGHTED_LABELS, as_optional
from curate.priors.base import Column as Declared
from db.models import Base, EvidenceSource

OWN_TABLES: Mapping[str, str] = {
    "points": "point_prior", "semantic": "semantic_prior", "probability": "weight",
}  # fmt: skip
"""Sources with a table in the schema, and the name of that table."""
_KEY = ("round", "frame_id", "k")
_TYPES: Mapping[str, TypeEngine[Any]] = {
    "int32": Integer(), "int64": BigInteger(), "float64": Float(53), "name": Text(),
}  # fmt: skip
_RECORD = Base.metadata.tables[EvidenceSource.__tablename__]


@dataclass(frozen=True)
class Declaration:
    """The columns that an evidence source stores.

    Attributes:
        name: name of the source.
        source: its name in the configuration: a registered name, or `package.module:Class`.
        columns: its columns, without the key of the label.
        rho_column: see `curate.priors.base.EvidenceDeclaration`.
    """

    name: str
    source: str
    columns: tuple[Declared, ...]
    rho_column: str | None

    @property
    def table(self) -> str:
        """Name of the source's table."""
        return OWN_TABLES.get(self.name, f"prior_{self.name}")

    @property
    def layout(self) -> tuple[Any, ...]:
        """What stored evidence depends on: all but the meanings, which are only shown."""
        columns = tuple((each.name, each.kind, each.unit, each.optional) for each in self.columns)
        return self.name, self.source, columns, self.rho_column


PROBABILITY = Declaration(
    "probability",
    "calibrate",
    (Declared("probability", "float64", "1", "p, that the label is correct", optional=True),),
    None,
)
"""The column of the weights of policies that estimate a probability."""


def evidence_table(declaration: Declaration) -> Table:
    """Return the table of a source."""
    if declaration.name in OWN_TABLES:
        return Base.metadata.tables[declaration.table]
    prediction = Base.metadata.tables["prediction"]
    columns = [
        Column(each.name, _TYPES[each.kind], nullable=each.optional, comment=each.meaning)
        for each in declaration.columns
    ]
    return Table(
        declaration.table,
        MetaData(naming_convention=Base.metadata.naming_convention),
        *(Column(name, Integer, primary_key=True, autoincrement=False) for name in _KEY),
        *columns,
        ForeignKeyConstraint(_KEY, [prediction.c[name] for name in _KEY], ondelete="CASCADE"),
        sqlite_with_rowid=False,
    )


def read_declarations(connection: Connection) -> tuple[Declaration, ...]:
    """Return the stored declarations, sorted by name; the probability comes after the evidence."""
    c = _RECORD.c
    rows = connection.execute(select(c.name, c.source, c.columns, c.rho_column).order_by(c.name))
    found = (
        Declaration(
            row.name,
            row.source,
            tuple(Declared(**column) for column in json.loads(row.columns)),
            row.rho_column,
        )
        for row in rows
    )
    return tuple(sorted(found, key=lambda each: each.name == PROBABILITY.name))


def declare(connection: Connection, declaration: Declaration) -> None:
    """Create the table of a source if it is missing, and record its declaration.

    A table of the same name with other columns, or of another class, is replaced by an empty one,
    and the tasks of that source are deleted, so that its evidence is computed again. If only the
    meaning of a column has been reworded, the evidence stays. The caller recreates the views.
    """
    former = {each.name: each for each in read_declarations(connection)}.get(declaration.name)
    if former == declaration:
        return
    own = declaration.name in OWN_TABLES
    same = former is not None and former.layout == declaration.layout
    if former is not None:
        connection.execute(_RECORD.delete().where(_RECORD.c.name == declaration.name))
        if not same:
            if not own:
                connection.execute(DropTable(evidence_table(former)))
            task = Base.metadata.tables["task"]
            connection.execute(task.delete().where(task.c.stage == former.source))
    if not (same or own):
        connection.execute(CreateTable(evidence_table(declaration)))
    row = {
        "name": declaration.name,
        "source": declaration.source,
        "columns": json.dumps([asdict(column) for column in declaration.columns]),
        "rho_column": declaration.rho_column,
    }
    connection.execute(_RECORD.insert().values(**row))


def weighted_label_columns(connection: Connection) -> tuple[Declared, ...]:
    """Return all columns of the view `weighted_labels`: the core ones, then further evidence."""
    return label_columns(read_declarations(connection))


def label_columns(declarations: Sequence[Declaration]) -> tuple[Declared, ...]:
    """Return the core columns of a weighted label, then those of further sources."""
    further = (column for each in declarations for column in each.columns)
    return (*WEIGHTED_LABELS, *as_optional(tuple(further)))
