"""Audits at equal weighted recall, calibration errors by chance, and differences of policies."""

import sqlalchemy as sa
from alembic import op

from db.ddl import integer, key, real, table, text

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None

_NUMBERS = (
    "calibration_error_by_chance",
    "calibration_error_limit",
    "equal_recall_power",
    "equal_recall_precision",
)
_BOUNDS = ("equal_recall_precision_low", "equal_recall_precision_high")


def upgrade() -> None:
    """Upgrade the schema."""
    for name in ("audit", "audit_slice"):
        for column in _columns():
            op.add_column(name, column)
    table(
        "audit_difference",
        key("round", "of the teacher"),
        text("frames", "which: val, labeled, or e.g. 5 folds", primary_key=True),
        text("overlap", "bev | 3d", primary_key=True),
        text("policy", "or score, rho_det, consistency: evidence by itself", primary_key=True),
        text("category", "or 'all'", primary_key=True),
        text("other", primary_key=True),
        text("figure", primary_key=True),
        real("difference"),
        real("low", "bound of its interval", nullable=True),
        real("high", "bound of its interval", nullable=True),
        integer("real"),
    )


def downgrade() -> None:
    """Downgrade the schema."""
    op.drop_table("audit_difference")
    for name in ("audit", "audit_slice"):
        for column in _columns():
            op.drop_column(name, column.name)


def _columns() -> list[sa.Column[float] | sa.Column[str]]:
    """Return the new columns of the tables of figures."""
    return [
        text("reference", nullable=True),
        *(real(name, nullable=True) for name in _NUMBERS),
        *(real(name, "bound of its interval", nullable=True) for name in _BOUNDS),
    ]
