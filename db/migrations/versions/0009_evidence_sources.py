"""The declarations of evidence sources, and the hashes of the views' definitions."""

import sqlalchemy as sa
from alembic import op

from db.ddl import table, text

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade the schema; the views are created after the migrations."""
    table(
        "evidence_source",
        text("name", "its table is prior_NAME", primary_key=True),
        text("source", "as run.priors names it"),
        text("columns", "JSON: name, kind, unit, meaning and optional of each"),
        text(
            "rho_column", "the column with its trust in [0, 1]; null = not a prior", nullable=True
        ),
    )
    table(
        "view_definition",
        text("name", "of the view", primary_key=True),
        text("sha256", "of its definition"),
    )


def downgrade() -> None:
    """Downgrade the schema and drop the tables of the evidence sources."""
    connection = op.get_bind()
    for (name,) in connection.execute(sa.text("SELECT name FROM evidence_source")).all():
        op.drop_table(f"prior_{name}")
    op.drop_table("evidence_source")
    op.drop_table("view_definition")
