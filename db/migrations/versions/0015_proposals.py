"""Candidates for missed objects."""

from alembic import op

from db.ddl import box, integer, key, table, text

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade the schema."""
    table(
        "proposal",
        key("round", "whose labels lack it; 0 = ground truth"),
        key("frame_id", refers="frame.id"),
        key("n"),
        text("category"),
        *box(),
        integer("points", "of the object"),
        integer("pixels", "of its mask that no label covers"),
        text("camera", "of several; null = one", nullable=True),
        text("provenance"),
    )


def downgrade() -> None:
    """Downgrade the schema."""
    op.drop_table("proposal")
