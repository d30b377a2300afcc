"""The view weighted_labels gives weights bare, so that questions find them by their index.

Views are made anew after every migration; this revision only says that there is a newer one.
"""

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Goes forward."""


def downgrade() -> None:
    """Goes back."""
