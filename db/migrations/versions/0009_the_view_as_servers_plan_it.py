"""The view names the split as it is, which a server knows; every migration makes the views anew."""

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Goes forward."""


def downgrade() -> None:
    """Goes back."""
