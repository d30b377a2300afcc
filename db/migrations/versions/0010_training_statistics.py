"""The curves of trainings: loss terms, learning rate and gradient norm of every few steps."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Adds the table."""
    op.create_table(
        "training_statistics",
        sa.Column("round", sa.Integer(), nullable=False, comment="as of the checkpoint"),
        sa.Column("policy", sa.Text(), nullable=False, comment="as of the checkpoint"),
        sa.Column("step", sa.Integer(), nullable=False, comment="of the optimiser, from 1"),
        sa.Column(
            "name",
            sa.Text(),
            nullable=False,
            comment="loss, a term of it, learning_rate or gradient_norm",
        ),
        sa.Column(
            "value", sa.Float(53), nullable=True, comment="of this step alone; null = not finite"
        ),
        sa.PrimaryKeyConstraint(
            "round", "policy", "step", "name", name=op.f("pk_training_statistics")
        ),
        sqlite_with_rowid=False,
    )


def downgrade() -> None:
    """Removes the table."""
    op.drop_table("training_statistics")
