"""The tables of audits and evaluations."""

from typing import Any

import sqlalchemy as sa
from alembic import op

from db.ddl import box, integer, key, real, table, text

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

_FIGURES = {
    "share_right": None,
    "auroc": "chance that a right label weighs more than a wrong one",
    "average_precision": "of the labels ranked by weight",
    "weighted_precision": "share of the weight that lies on right labels",
    "weighted_recall": "weight on right labels per object",
    "calibration_error": "expected distance of weight and share of right labels",
}


def upgrade() -> None:
    """Upgrade the schema."""
    table("audit", *_audited(), *_judgement())
    table(
        "audit_bin",
        *_audited(),
        real("low", "weight, included", primary_key=True),
        real("high", "weight, not included"),
        integer("labels"),
        real("mean_weight", nullable=True),
        real("precision", "share of right labels in the bin", nullable=True),
        real("recall", "right labels of the bin per object", nullable=True),
    )
    table(
        "audit_slice",
        *_audited(),
        text("kind", "distance | points", primary_key=True),
        real("low", "metres or points, included", primary_key=True),
        real("high", "metres or points, not included; null = open", nullable=True),
        *_judgement(),
    )
    table(
        "evaluation_ap",
        _source(),
        text("category", primary_key=True),
        text("figure", "image | aos | bev | 3d", primary_key=True),
        text("difficulty", "easy | moderate | hard", primary_key=True),
        integer("objects", "that count"),
        real("ap_r40", "percent", nullable=True),
        real("ap_r11", "percent", nullable=True),
    )
    table(
        "evaluation_object",
        _source(),
        integer("frame_id", primary_key=True, refers="frame.id"),
        text("side", "object | detection", primary_key=True),
        key("k", "of ground_truth or of prediction"),
        text("category", "under evaluation; a Van is an ignored object of Car", primary_key=True),
        text("outcome", "tp | fp | fn | ignored"),
        integer("matched_k", "of the other side", nullable=True),
        real("iou", "with the match, else the greatest with any that took part"),
        real("score", "of the detection, for objects of the matched one", nullable=True),
        text("overlap", "what iou is: image | bev | 3d"),
        text("difficulty", "objects beyond it are ignored"),
        *box(),
        sa.CheckConstraint("outcome IN ('tp', 'fp', 'fn', 'ignored')", name="outcome"),
        sa.CheckConstraint("side IN ('object', 'detection')", name="side"),
    )
    op.create_index("ix_evaluation_object_outcome", "evaluation_object", ["source", "outcome"])


def _source() -> sa.Column[Any]:
    meaning = "whose detections: e.g. round 1, or a checkpoint's path"
    return text("source", meaning, primary_key=True)


def _audited() -> list[sa.Column[Any]]:
    """Return the key columns of the audit tables."""
    return [
        key("round", "of the teacher"),
        text("frames", "which: val, labeled, or e.g. 5 folds", primary_key=True),
        text("overlap", "bev | 3d", primary_key=True),
        text("policy", "or score, rho_det, consistency: evidence by itself", primary_key=True),
        text("category", "or 'all'", primary_key=True),
    ]


def _judgement() -> list[sa.Column[Any]]:
    """Return the columns with the figures of an audit."""
    bound = "bound of its interval"
    return [
        integer("labels", "that are right or wrong"),
        integer("neutral", "further labels that are neither"),
        integer("right_labels", "of the labels"),
        integer("objects", "to be found; null = unknown", nullable=True),
        *(
            real(column, comment, nullable=True)
            for name, meaning in _FIGURES.items()
            for column, comment in (
                (name, meaning), (f"{name}_low", bound), (f"{name}_high", bound),
            )
        ),
    ]  # fmt: skip


def downgrade() -> None:
    """Downgrade the schema."""
    for name in ("evaluation_object", "evaluation_ap", "audit_slice", "audit_bin", "audit"):
        op.drop_table(name)
