"""Counts of weighted labels, and an index of frames by name."""

from alembic import op

from db.ddl import integer, real, table, text

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade the schema and count the labels that already have weights."""
    table(
        "label_count",
        integer("round", primary_key=True, refers="round.number"),
        text("policy", primary_key=True),
        text("category", primary_key=True),
        integer("labels", "that the policy did not drop"),
        integer("kept", "with a weight above 0"),
        integer("trusted", "with a weight above 0.5"),
        real("weight", "sum of the weights"),
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
    """Downgrade the schema."""
    op.drop_index("ix_frame_frame", "frame")
    op.drop_table("label_count")
