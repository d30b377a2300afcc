"""The tables of the data model: frames, rounds, predictions, evidence and weights."""

from typing import Any

import sqlalchemy as sa
from alembic import op

from db.ddl import (
    RADIANS,
    SHARE,
    box,
    deleted_with,
    integer,
    key,
    prediction_key,
    real,
    table,
    text,
)

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

_TABLES = (
    "checkpoint", "frame", "ground_truth", "round", "task", "prediction", "reprediction_view",
    "consistency", "point_prior", "reprediction", "semantic_prior", "weight",
)  # fmt: skip


def upgrade() -> None:
    """Upgrade the schema."""
    _frames()
    _rounds()
    _predictions()
    _evidence()
    if op.get_bind().dialect.name == "sqlite":
        # The foreign key rejects such a row too, but not on connections with foreign keys off.
        op.execute(
            """
            CREATE TRIGGER ground_truth_never_unlabeled BEFORE INSERT ON ground_truth
            WHEN (SELECT split FROM frame WHERE id = NEW.frame_id) = 'unlabeled'
            BEGIN SELECT RAISE(ABORT, 'ground truth of an unlabeled frame'); END
            """
        )


def _frames() -> None:
    below = "relative to the data set's root"
    op.create_table(
        "frame",
        integer("id", primary_key=True),
        text("dataset"),
        text("frame", "frame id within the data set"),
        text("split", "labeled | unlabeled | val"),
        text("points_path", below),
        text("image_path", below),
        text("calibration_path", below),
        text("label_path", f"{below}; never for unlabeled frames", nullable=True),
        sa.CheckConstraint(
            "split <> 'unlabeled' OR label_path IS NULL", name="unlabeled_has_no_label"
        ),
        sa.CheckConstraint("split IN ('labeled', 'unlabeled', 'val')", name="split"),
        sa.UniqueConstraint("dataset", "frame"),
        sa.UniqueConstraint("id", "split"),
    )
    table(
        "ground_truth",
        key("frame_id"),
        key("k"),
        text("split"),
        text("category"),
        *box(nullable=True),
        real("truncated", SHARE),
        integer("occluded", "KITTI's levels 0 to 3"),
        real("alpha", RADIANS),
        *(real(f"image_{side}", "pixels") for side in ("left", "top", "right", "bottom")),
        sa.CheckConstraint("split IN ('labeled', 'val')", name="never_unlabeled"),
        sa.ForeignKeyConstraint(["frame_id", "split"], ["frame.id", "frame.split"]),
    )


def _rounds() -> None:
    op.create_table(
        "checkpoint",
        integer("id", primary_key=True),
        integer("round", "the round that made it; 0 before the first"),
        text("policy", "whose weights it learned from; '' for round 0"),
        text("detector"),
        text("path", "relative to the workspace, or absolute"),
        text("sha256"),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.UniqueConstraint("round", "policy"),
    )
    op.create_table(
        "round",
        key("number"),
        integer("rounds", "E: e/E is the age of Eq. 4"),
        integer("teacher_id", refers="checkpoint.id", nullable=True),
        text("config", "the whole configuration, JSON"),
        text("code_version"),
        integer("seed"),
    )
    op.create_table(
        "task",
        integer("id", primary_key=True),
        integer("round"),
        text("stage"),
        text("variant", "policy or format of a round stage, else ''"),
        integer("frame_id", refers="frame.id", nullable=True),
        text("fingerprint", "of all that the result depends on"),
        text("state", "done | empty | failed"),
        text("error", nullable=True),
        real("seconds"),
        sa.CheckConstraint("(state = 'failed') = (error IS NOT NULL)", name="error_iff_failed"),
        sa.CheckConstraint("state IN ('done', 'empty', 'failed')", name="state"),
    )
    for name, last, null in (("frame", "frame_id", "NOT NULL"), ("round", "variant", "NULL")):
        where = sa.text(f"frame_id IS {null}")
        op.create_index(
            f"uq_task_{name}",
            "task",
            ["round", "stage", last],
            unique=True,
            sqlite_where=where,
            postgresql_where=where,
        )


def _predictions() -> None:
    table(
        "prediction",
        *_round_and_frame(),
        key("k"),
        text("category"),
        real("score", SHARE),
        *box(),
    )
    op.create_index("ix_prediction_category_score", "prediction", ["round", "category", "score"])
    table(
        "reprediction_view",
        *_round_and_frame(),
        key("view"),
        integer("flip_y", "1 if y was mirrored, first"),
        real("rotation_rad", "about z, radians, second"),
        real("scale", "of all coordinates, third"),
    )
    table(
        "reprediction",
        key("round"),
        key("frame_id"),
        key("view"),
        key("k", "number within the view"),
        text("category"),
        real("score", SHARE),
        integer("matched_k", "prediction.k; null = no match", nullable=True),
        real("iou", "BEV IoU of the match", nullable=True),
        real("score_loss", "-ln of this score", nullable=True),
        real("box_loss", "sum of smooth L1, beta 1/9", nullable=True),
        *box(),
        deleted_with("reprediction_view", "round", "frame_id", "view"),
    )


def _round_and_frame() -> list[sa.Column[Any]]:
    return [
        integer("round", primary_key=True, refers="round.number"),
        integer("frame_id", primary_key=True, refers="frame.id"),
    ]


def _evidence() -> None:
    evidence = {
        "consistency": [
            real("loss", "L; null = no match, no evidence", nullable=True),
            integer("views"),
            integer("matched_views"),
        ],
        "point_prior": [
            integer("points", "m"),
            real("points_threshold", "m_th of the category"),
            real("rho_diff", SHARE),
        ],
        "semantic_prior": [
            integer("mask_pixels", "S"),
            integer("box_pixels", "A; 0 = outside the image"),
            real("rho_anno", SHARE),
        ],
        "weight": [
            text("policy", primary_key=True),
            real("lambda_u", "Eq. 4; null where unused", nullable=True),
            real("rho_det", "product of the priors", nullable=True),
            real("v", SHARE),
        ],
    }
    for name, columns in evidence.items():
        table(
            name, *prediction_key(), *columns, deleted_with("prediction", "round", "frame_id", "k")
        )
    op.create_index("ix_weight_policy_v", "weight", ["round", "policy", "v"])


def downgrade() -> None:
    """Downgrade the schema."""
    for name in reversed(_TABLES):
        op.drop_table(name)
