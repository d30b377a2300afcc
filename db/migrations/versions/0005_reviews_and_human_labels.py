"""Reviews, the human labels from them, and the predictions that match human labels."""

import sqlalchemy as sa
from alembic import op

from db.ddl import (
    METRES,
    RADIANS,
    SIDES,
    box,
    deleted_with,
    integer,
    key,
    prediction_key,
    real,
    table,
    text,
)

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade the schema."""
    op.create_table(
        "review",
        text("id", "hash of its manifest", primary_key=True),
        integer("round", "whose labels"),
        text("policy", "whose weights chose them"),
        text("editor", "kitti | labelcloud | cvat"),
        integer("frames"),
        integer("boxes", "in all, those for context included"),
        integer("asked", "of the boxes"),
        text("exported_at", "ISO 8601, UTC"),
        text("imported_at", "ISO 8601, UTC; null = not yet", nullable=True),
    )
    seen = dict.fromkeys(SIDES, METRES) | {"yaw": RADIANS}
    seen["x"] = f"{METRES}: the box as it was shown; null = none"
    table(
        "human_label",
        key("frame_id"),
        key("n"),
        text("split"),
        text("review", refers="review.id"),
        integer("item", "number of the box in the review; null = added", nullable=True),
        text("decision", "accepted | rejected | moved | added"),
        text("category"),
        integer("from_round", "it counts in this round and later"),
        *box(),
        *(real(f"seen_{name}", meaning, nullable=True) for name, meaning in seen.items()),
        text("reviewer", "who decided"),
        text("decided_at", "ISO 8601, UTC"),
        sa.CheckConstraint("split = 'unlabeled'", name="only_unlabeled"),
        sa.CheckConstraint(
            "decision IN ('accepted', 'rejected', 'moved', 'added')", name="decision"
        ),
        sa.ForeignKeyConstraint(["frame_id", "split"], ["frame.id", "frame.split"]),
    )
    op.create_index("ix_human_label_review", "human_label", ["review"])
    table(
        "human_match",
        *prediction_key(),
        integer("n", "human_label.n"),
        real("iou", "BEV IoU with its box, or the one seen"),
        integer("leads", "1 if the human label stands in weighted_labels under this k"),
        deleted_with("prediction", "round", "frame_id", "k"),
        deleted_with("human_label", "frame_id", "n"),
    )
    op.create_index("ix_human_match_label", "human_match", ["frame_id", "n"])


def downgrade() -> None:
    """Downgrade the schema; the next upgrade recreates the view, which reads these tables."""
    op.execute("DROP VIEW IF EXISTS weighted_labels")
    for name in ("human_match", "human_label", "review"):
        op.drop_table(name)
