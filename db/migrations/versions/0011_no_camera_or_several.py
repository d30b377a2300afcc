"""Frames without an image, and the camera of several that gave a label its image evidence."""

from alembic import op

from db.ddl import text

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

_CAMERA = "of several, the one that shows most of the box; null = one camera, or none shows it"


def upgrade() -> None:
    """Upgrade the schema."""
    meaning = "of the first camera, relative to the data set's root; null = no images"
    op.add_column("frame", text("image_file", meaning, nullable=True))
    op.execute("UPDATE frame SET image_file = image_path")
    _replace_image_path()
    op.add_column("semantic_prior", text("camera", _CAMERA, nullable=True))


def downgrade() -> None:
    """Downgrade the schema; frames without an image get an empty path."""
    op.execute("DELETE FROM evidence_source WHERE name = 'semantic'")
    op.drop_column("semantic_prior", "camera")
    op.add_column("frame", text("image_file", "relative to the data set's root", server_default=""))
    op.execute("UPDATE frame SET image_file = COALESCE(image_path, '')")
    _replace_image_path()


def _replace_image_path() -> None:
    """Put the column image_file in the place of image_path.

    SQLite could change the column itself only by copying the table, to which others refer.
    """
    op.drop_column("frame", "image_path")
    op.execute("ALTER TABLE frame RENAME COLUMN image_file TO image_path")
