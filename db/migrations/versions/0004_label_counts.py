"""Counts of weighed labels, and frames found by their name alone."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Goes forward; what has been weighed before is counted."""
    op.create_table(
        "label_count",
        sa.Column("round", sa.Integer(), nullable=False),
        sa.Column("policy", sa.Text(), nullable=False),
        sa.Column("category", sa.Text(), nullable=False),
        sa.Column("labels", sa.Integer(), nullable=False, comment="that the policy did not drop"),
        sa.Column("kept", sa.Integer(), nullable=False, comment="with a weight above 0"),
        sa.Column("trusted", sa.Integer(), nullable=False, comment="with a weight above 0.5"),
        sa.Column("weight", sa.Float(precision=53), nullable=False, comment="sum of the weights"),
        sa.ForeignKeyConstraint(["round"], ["round.number"], name=op.f("fk_label_count_round")),
        sa.PrimaryKeyConstraint("round", "policy", "category", name=op.f("pk_label_count")),
        sqlite_with_rowid=False,
    )
    op.execute("""
        INSERT INTO label_count
        SELECT w.round, w.policy, p.category, count(*),
               sum(CASE WHEN w.v > 0 THEN 1 ELSE 0 END),
               sum(CASE WHEN w.v > 0.5 THEN 1 ELSE 0 END), sum(w.v)
        FROM weight AS w
        JOIN prediction AS p ON p.round = w.round AND p.frame_id = w.frame_id AND p.k = w.k
        GROUP BY w.round, w.policy, p.category
    """)
    op.create_index("ix_frame_frame", "frame", ["frame"])


def downgrade() -> None:
    """Goes back."""
    op.drop_index("ix_frame_frame", "frame")
    op.drop_table("label_count")
