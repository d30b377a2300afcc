"""Columns and tables as migrations write them; the naming convention of the models names the rest.

Migrations are history: what is written here must never change a schema that they made.
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
    """Return a column that is never null, unless `nullable=True` says otherwise."""
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
    """Return the key of what belongs to a prediction."""
    return [key("round"), key("frame_id"), key("k")]


def leaves_with(other: str, *columns: str) -> sa.ForeignKeyConstraint:
    """Return the constraint that deletes a row together with the one of another table."""
    return sa.ForeignKeyConstraint(
        columns, [f"{other}.{column}" for column in columns], ondelete="CASCADE"
    )
