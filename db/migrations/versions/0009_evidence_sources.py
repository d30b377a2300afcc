"""What evidence sources declare, and the definitions of the views."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Make both tables; the views are made after the migrations."""
    op.create_table(
        "evidence_source",
        sa.Column("name", sa.Text(), nullable=False, comment="its table is prior_NAME"),
        sa.Column("source", sa.Text(), nullable=False, comment="as run.priors names it"),
        sa.Column(
            "columns",
            sa.Text(),
            nullable=False,
            comment="JSON: name, kind, unit, meaning and optional of each",
        ),
        sa.Column(
            "rho_column",
            sa.Text(),
            nullable=True,
            comment="the column with its trust in [0, 1]; null = not a prior",
        ),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_evidence_source")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "view_definition",
        sa.Column("name", sa.Text(), nullable=False, comment="of the view"),
        sa.Column("sha256", sa.Text(), nullable=False, comment="of its definition"),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_view_definition")),
        sqlite_with_rowid=False,
    )


def downgrade() -> None:
    """Drop both tables, and those of the sources."""
    connection = op.get_bind()
    for (name,) in connection.execute(sa.text("SELECT name FROM evidence_source")).all():
        op.drop_table(f"prior_{name}")
    op.drop_table("evidence_source")
    op.drop_table("view_definition")
