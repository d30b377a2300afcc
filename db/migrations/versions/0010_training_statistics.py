"""Training curves: loss terms, learning rate and gradient norm of every few steps."""

from alembic import op

from db.ddl import key, real, table, text

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade the schema."""
    table(
        "training_statistics",
        key("round", "as of the checkpoint"),
        text("policy", "as of the checkpoint", primary_key=True),
        key("step", "of the optimiser, from 1"),
        text("name", "loss, a term of it, learning_rate or gradient_norm", primary_key=True),
        real("value", "of this step alone; null = not finite", nullable=True),
    )


def downgrade() -> None:
    """Downgrade the schema."""
    op.drop_table("training_statistics")
