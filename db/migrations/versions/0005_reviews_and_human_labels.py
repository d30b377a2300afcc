"""Reviews, what people decided in them, and the predictions that they speak for."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

_METRES, _RADIANS = "metres, LiDAR frame", "radians, (-pi, pi]"
_SIDES = ("x", "y", "z", "length", "width", "height")


def upgrade() -> None:
    """Goes forward."""
    op.create_table(
        "review",
        sa.Column("id", sa.Text(), nullable=False, comment="hash of its manifest"),
        sa.Column("round", sa.Integer(), nullable=False, comment="whose labels"),
        sa.Column("policy", sa.Text(), nullable=False, comment="whose weights chose them"),
        sa.Column("editor", sa.Text(), nullable=False, comment="kitti | labelcloud | cvat"),
        sa.Column("frames", sa.Integer(), nullable=False),
        sa.Column(
            "boxes", sa.Integer(), nullable=False, comment="in all, those for context included"
        ),
        sa.Column("asked", sa.Integer(), nullable=False, comment="of the boxes"),
        sa.Column("exported_at", sa.Text(), nullable=False, comment="ISO 8601, UTC"),
        sa.Column("imported_at", sa.Text(), comment="ISO 8601, UTC; null = not yet"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_review")),
    )
    _human_label()
    _human_match()


def _human_label() -> None:
    seen = "metres, LiDAR frame: the box as it was shown; null = none"
    op.create_table(
        "human_label",
        sa.Column("frame_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("n", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("split", sa.Text(), nullable=False),
        sa.Column("review", sa.Text(), nullable=False),
        sa.Column("item", sa.Integer(), comment="number of the box in the review; null = added"),
        sa.Column(
            "decision", sa.Text(), nullable=False, comment="accepted | rejected | moved | added"
        ),
        sa.Column("category", sa.Text(), nullable=False),
        sa.Column(
            "from_round",
            sa.Integer(),
            nullable=False,
            comment="it counts in this round and later",
        ),
        *(sa.Column(name, sa.Float(53), nullable=False, comment=_METRES) for name in _SIDES),
        sa.Column("yaw", sa.Float(53), nullable=False, comment=_RADIANS),
        *(
            sa.Column(f"seen_{name}", sa.Float(53), comment=seen if name == "x" else _METRES)
            for name in _SIDES
        ),
        sa.Column("seen_yaw", sa.Float(53), comment=_RADIANS),
        sa.Column("reviewer", sa.Text(), nullable=False, comment="who decided"),
        sa.Column("decided_at", sa.Text(), nullable=False, comment="ISO 8601, UTC"),
        sa.CheckConstraint("split = 'unlabeled'", name=op.f("ck_human_label_only_unlabeled")),
        sa.CheckConstraint(
            "decision IN ('accepted', 'rejected', 'moved', 'added')",
            name=op.f("ck_human_label_decision"),
        ),
        sa.ForeignKeyConstraint(
            ["frame_id", "split"],
            ["frame.id", "frame.split"],
            name=op.f("fk_human_label_frame_id_split"),
        ),
        sa.ForeignKeyConstraint(["review"], ["review.id"], name=op.f("fk_human_label_review")),
        sa.PrimaryKeyConstraint("frame_id", "n", name=op.f("pk_human_label")),
        sqlite_with_rowid=False,
    )
    op.create_index("ix_human_label_review", "human_label", ["review"])


def _human_match() -> None:
    op.create_table(
        "human_match",
        sa.Column("round", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("frame_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("k", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("n", sa.Integer(), nullable=False, comment="human_label.n"),
        sa.Column(
            "iou", sa.Float(53), nullable=False, comment="BEV IoU with its box, or the one seen"
        ),
        sa.Column(
            "leads",
            sa.Integer(),
            nullable=False,
            comment="1 if the human label stands in weighted_labels under this k",
        ),
        sa.ForeignKeyConstraint(
            ["round", "frame_id", "k"],
            ["prediction.round", "prediction.frame_id", "prediction.k"],
            name=op.f("fk_human_match_round_frame_id_k"),
            ondelete="CASCADE",
        ),
        sa.ForeignKeyConstraint(
            ["frame_id", "n"],
            ["human_label.frame_id", "human_label.n"],
            name=op.f("fk_human_match_frame_id_n"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("round", "frame_id", "k", name=op.f("pk_human_match")),
        sqlite_with_rowid=False,
    )
    op.create_index("ix_human_match_label", "human_match", ["frame_id", "n"])


def downgrade() -> None:
    """Goes back; the views, which name these tables, are made again by the next upgrade."""
    op.execute("DROP VIEW IF EXISTS weighted_labels")
    for name in ("human_match", "human_label", "review"):
        op.drop_table(name)
