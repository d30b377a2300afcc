"""Fused boxes of labels, and the references of the semantic prior."""

from alembic import op

from db.ddl import box, deleted_with, integer, prediction_key, real, table, text

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade the schema."""
    table(
        "fused_box",
        *prediction_key(),
        *box(),
        integer("boxes", "in the mean; 1 = the prediction alone"),
        deleted_with("prediction", "round", "frame_id", "k"),
    )
    table(
        "semantic_reference",
        text("category", primary_key=True),
        integer("boxes", "labeled boxes that an image shows"),
        real("upper_quartile", "of S/A; null = no such box", nullable=True),
        text("fingerprint", "of all that it depends on"),
    )
    meaning = "by which S/A was divided; null = it was not"
    op.add_column("semantic_prior", real("share_reference", meaning, nullable=True))


def downgrade() -> None:
    """Downgrade the schema; labels get the boxes of their predictions back."""
    # SQLite alters no table while a view reads one that is gone. Opening recreates the views.
    op.execute("DROP VIEW IF EXISTS weighted_labels")
    op.execute("DELETE FROM evidence_source WHERE name = 'semantic'")
    op.drop_column("semantic_prior", "share_reference")
    op.drop_table("semantic_reference")
    op.drop_table("fused_box")
