"""The detector's estimate of its IoU with the object."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Goes forward."""
    op.add_column(
        "prediction",
        sa.Column(
            "iou",
            sa.Float(precision=53),
            nullable=True,
            comment="the detector's estimate of its 3D IoU with the object; null = it makes none",
        ),
    )


def downgrade() -> None:
    """Goes back."""
    op.drop_column("prediction", "iou")
