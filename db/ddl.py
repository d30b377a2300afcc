"""Short forms of columns and tables for migrations.

Indexes and constraints get their names from the naming convention of the models. Migrations are
history: a change here must never change the schema that an old migration creates.
"""

from functools import partial
from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.types import TypeEngine

METRES, RADIANS, SHARE = "metres, LiDAR frame", "radians, (-pi, pi]", "0 to 1"
SIDES = ("x", "y", "z", "length", "width", "height")


def _column(
    kind: TypeEngine[Any], name: str, comment: str | None = None, **options: Any
) -> sa.Column[Any]:
    """Return a column, not nullable by default; `refers` is the column of a foreign key."""
    foreign = [sa.ForeignKey(options.pop("refers"))] if "refers" in options else []
    return sa.Column(name, kind, *foreign, comment=comment, **{"nullable": False, **options})


text = partial(_column, sa.Text())
integer = partial(_column, sa.Integer())
real = partial(_column, sa.Float(53))
key = partial(integer, primary_key=True, autoincrement=False)
table = partial(op.create_table, sqlite_with_rowid=False)


def box(*, nullable: bool = False) -> list[sa.Column[Any]]:
    """Return the seven columns of a box."""
    return [
        *(real(name, METRES, nullable=nullable) for name in SIDES),
        real("yaw", RADIANS, nullable=nullable),
    ]


def prediction_key() -> list[sa.Column[Any]]:
    """Return the key columns of a table with rows that belong to predictions."""
    return [key("round"), key("frame_id"), key("k")]


def deleted_with(other: str, *columns: str) -> sa.ForeignKeyConstraint:
    """Return a foreign key that deletes a row together with the row that it refers to.

    Args:
        other: name of the other table.
        columns: names of the columns of the key, the same in both tables.
    """
    return sa.ForeignKeyConstraint(
        columns, [f"{other}.{column}" for column in columns], ondelete="CASCADE"
    )
