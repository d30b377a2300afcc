"""The detector's estimate of a prediction's IoU with the object."""

from alembic import op

from db.ddl import real

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade the schema."""
    meaning = "the detector's estimate of its 3D IoU with the object; null = it makes none"
    op.add_column("prediction", real("iou", meaning, nullable=True))


def downgrade() -> None:
    """Downgrade the schema."""
    op.drop_column("prediction", "iou")
