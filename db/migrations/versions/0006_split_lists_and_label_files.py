"""What the leakage firewall compares: lists of frames, and label files as they were written."""

import hashlib

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Goes forward; the splits of an older workspace are taken as they are."""
    lists = op.create_table(
        "split_list",
        sa.Column(
            "source",
            sa.Text(),
            nullable=False,
            comment="chosen | dataset (its own) | file (given to init)",
        ),
        sa.Column(
            "name",
            sa.Text(),
            nullable=False,
            comment="labeled | unlabeled | val, or of the data set's list",
        ),
        sa.Column("path", sa.Text(), nullable=True, comment="of the file"),
        sa.Column("frames", sa.Integer(), nullable=False, comment="how many"),
        sa.Column("sha256", sa.Text(), nullable=False, comment="of names"),
        sa.Column("names", sa.Text(), nullable=False, comment="the sorted names, one per line"),
        sa.PrimaryKeyConstraint("source", "name", name=op.f("pk_split_list")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "label_file",
        sa.Column("path", sa.Text(), nullable=False, comment="relative to the workspace"),
        sa.Column("round", sa.Integer(), nullable=False, comment="0 = ground truth of X_l alone"),
        sa.Column("policy", sa.Text(), nullable=False),
        sa.Column("sha256", sa.Text(), nullable=False, comment="of the file"),
        sa.PrimaryKeyConstraint("path", name=op.f("pk_label_file")),
        sqlite_with_rowid=False,
    )
    frames = op.get_bind().execute(sa.text("SELECT frame, split FROM frame")).all()
    if not frames:
        return
    for split in ("labeled", "unlabeled", "val"):
        names = sorted(frame for frame, of in frames if of == split)
        text = "".join(f"{name}\n" for name in names)
        row = {"source": "chosen", "name": split, "path": None, "frames": len(names)}
        digest = hashlib.sha256(text.encode()).hexdigest()
        op.bulk_insert(lists, [{**row, "sha256": digest, "names": text}])


def downgrade() -> None:
    """Goes back."""
    op.drop_table("label_file")
    op.drop_table("split_list")
