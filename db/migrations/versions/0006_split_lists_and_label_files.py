"""The tables of the leakage firewall: lists of frames, and hashes of exported label files."""

import hashlib

import sqlalchemy as sa
from alembic import op

from db.ddl import integer, table, text

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade the schema and record the splits of an older workspace."""
    lists = table(
        "split_list",
        text("source", "chosen | dataset (its own) | file (given to init)", primary_key=True),
        text("name", "labeled | unlabeled | val, or of the data set's list", primary_key=True),
        text("path", "of the file", nullable=True),
        integer("frames", "how many"),
        text("sha256", "of names"),
        text("names", "the sorted names, one per line"),
    )
    table(
        "label_file",
        text("path", "relative to the workspace", primary_key=True),
        integer("round", "0 = ground truth of X_l alone"),
        text("policy"),
        text("sha256", "of the file"),
    )
    frames = op.get_bind().execute(sa.text("SELECT frame, split FROM frame")).all()
    if not frames:
        return
    for split in ("labeled", "unlabeled", "val"):
        names = sorted(frame for frame, of in frames if of == split)
        lines = "".join(f"{name}\n" for name in names)
        row = {"source": "chosen", "name": split, "path": None, "frames": len(names)}
        digest = hashlib.sha256(lines.encode()).hexdigest()
        op.bulk_insert(lists, [{**row, "sha256": digest, "names": lines}])


def downgrade() -> None:
    """Downgrade the schema."""
    op.drop_table("label_file")
    op.drop_table("split_list")
