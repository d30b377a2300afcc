"""The view weighted_labels returns the stored weight itself, so that queries can use its index.

Views are recreated after every migration; this revision only makes that happen.
"""

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade the schema."""


def downgrade() -> None:
    """Downgrade the schema."""
