"""The tables of audits and evaluations."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Goes forward."""
    op.create_table(
        "audit",
        sa.Column("round", sa.Integer(), nullable=False, comment="of the teacher"),
        sa.Column(
            "frames", sa.Text(), nullable=False, comment="which: val, labeled, or e.g. 5 folds"
        ),
        sa.Column("overlap", sa.Text(), nullable=False, comment="bev | 3d"),
        sa.Column(
            "policy",
            sa.Text(),
            nullable=False,
            comment="or score, rho_det, consistency: evidence by itself",
        ),
        sa.Column("category", sa.Text(), nullable=False, comment="or 'all'"),
        sa.Column("labels", sa.Integer(), nullable=False, comment="that are right or wrong"),
        sa.Column(
            "neutral", sa.Integer(), nullable=False, comment="further labels that are neither"
        ),
        sa.Column("right_labels", sa.Integer(), nullable=False, comment="of the labels"),
        sa.Column("objects", sa.Integer(), nullable=True, comment="to be found; null = unknown"),
        sa.Column("share_right", sa.Float(precision=53), nullable=True),
        sa.Column(
            "share_right_low",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "share_right_high",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "auroc",
            sa.Float(precision=53),
            nullable=True,
            comment="chance that a right label weighs more than a wrong one",
        ),
        sa.Column(
            "auroc_low", sa.Float(precision=53), nullable=True, comment="bound of its interval"
        ),
        sa.Column(
            "auroc_high", sa.Float(precision=53), nullable=True, comment="bound of its interval"
        ),
        sa.Column(
            "average_precision",
            sa.Float(precision=53),
            nullable=True,
            comment="of the labels ranked by weight",
        ),
        sa.Column(
            "average_precision_low",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "average_precision_high",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "weighted_precision",
            sa.Float(precision=53),
            nullable=True,
            comment="share of the weight that lies on right labels",
        ),
        sa.Column(
            "weighted_precision_low",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "weighted_precision_high",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "weighted_recall",
            sa.Float(precision=53),
            nullable=True,
            comment="weight on right labels per object",
        ),
        sa.Column(
            "weighted_recall_low",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "weighted_recall_high",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "calibration_error",
            sa.Float(precision=53),
            nullable=True,
            comment="expected distance of weight and share of right labels",
        ),
        sa.Column(
            "calibration_error_low",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "calibration_error_high",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.PrimaryKeyConstraint(
            "round", "frames", "overlap", "policy", "category", name=op.f("pk_audit")
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "audit_bin",
        sa.Column("round", sa.Integer(), nullable=False, comment="of the teacher"),
        sa.Column(
            "frames", sa.Text(), nullable=False, comment="which: val, labeled, or e.g. 5 folds"
        ),
        sa.Column("overlap", sa.Text(), nullable=False, comment="bev | 3d"),
        sa.Column(
            "policy",
            sa.Text(),
            nullable=False,
            comment="or score, rho_det, consistency: evidence by itself",
        ),
        sa.Column("category", sa.Text(), nullable=False, comment="or 'all'"),
        sa.Column("low", sa.Float(precision=53), nullable=False, comment="weight, included"),
        sa.Column("high", sa.Float(precision=53), nullable=False, comment="weight, not included"),
        sa.Column("labels", sa.Integer(), nullable=False),
        sa.Column("mean_weight", sa.Float(precision=53), nullable=True),
        sa.Column(
            "precision",
            sa.Float(precision=53),
            nullable=True,
            comment="share of right labels in the bin",
        ),
        sa.Column(
            "recall",
            sa.Float(precision=53),
            nullable=True,
            comment="right labels of the bin per object",
        ),
        sa.PrimaryKeyConstraint(
            "round", "frames", "overlap", "policy", "category", "low", name=op.f("pk_audit_bin")
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "audit_slice",
        sa.Column("round", sa.Integer(), nullable=False, comment="of the teacher"),
        sa.Column(
            "frames", sa.Text(), nullable=False, comment="which: val, labeled, or e.g. 5 folds"
        ),
        sa.Column("overlap", sa.Text(), nullable=False, comment="bev | 3d"),
        sa.Column(
            "policy",
            sa.Text(),
            nullable=False,
            comment="or score, rho_det, consistency: evidence by itself",
        ),
        sa.Column("category", sa.Text(), nullable=False, comment="or 'all'"),
        sa.Column("kind", sa.Text(), nullable=False, comment="distance | points"),
        sa.Column(
            "low", sa.Float(precision=53), nullable=False, comment="metres or points, included"
        ),
        sa.Column(
            "high",
            sa.Float(precision=53),
            nullable=True,
            comment="metres or points, not included; null = open",
        ),
        sa.Column("labels", sa.Integer(), nullable=False, comment="that are right or wrong"),
        sa.Column(
            "neutral", sa.Integer(), nullable=False, comment="further labels that are neither"
        ),
        sa.Column("right_labels", sa.Integer(), nullable=False, comment="of the labels"),
        sa.Column("objects", sa.Integer(), nullable=True, comment="to be found; null = unknown"),
        sa.Column("share_right", sa.Float(precision=53), nullable=True),
        sa.Column(
            "share_right_low",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "share_right_high",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "auroc",
            sa.Float(precision=53),
            nullable=True,
            comment="chance that a right label weighs more than a wrong one",
        ),
        sa.Column(
            "auroc_low", sa.Float(precision=53), nullable=True, comment="bound of its interval"
        ),
        sa.Column(
            "auroc_high", sa.Float(precision=53), nullable=True, comment="bound of its interval"
        ),
        sa.Column(
            "average_precision",
            sa.Float(precision=53),
            nullable=True,
            comment="of the labels ranked by weight",
        ),
        sa.Column(
            "average_precision_low",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "average_precision_high",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "weighted_precision",
            sa.Float(precision=53),
            nullable=True,
            comment="share of the weight that lies on right labels",
        ),
        sa.Column(
            "weighted_precision_low",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "weighted_precision_high",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "weighted_recall",
            sa.Float(precision=53),
            nullable=True,
            comment="weight on right labels per object",
        ),
        sa.Column(
            "weighted_recall_low",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "weighted_recall_high",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "calibration_error",
            sa.Float(precision=53),
            nullable=True,
            comment="expected distance of weight and share of right labels",
        ),
        sa.Column(
            "calibration_error_low",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.Column(
            "calibration_error_high",
            sa.Float(precision=53),
            nullable=True,
            comment="bound of its interval",
        ),
        sa.PrimaryKeyConstraint(
            "round",
            "frames",
            "overlap",
            "policy",
            "category",
            "kind",
            "low",
            name=op.f("pk_audit_slice"),
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "evaluation_ap",
        sa.Column(
            "source",
            sa.Text(),
            nullable=False,
            comment="whose detections: e.g. round 1, or a checkpoint's path",
        ),
        sa.Column("category", sa.Text(), nullable=False),
        sa.Column("figure", sa.Text(), nullable=False, comment="image | aos | bev | 3d"),
        sa.Column("difficulty", sa.Text(), nullable=False, comment="easy | moderate | hard"),
        sa.Column("objects", sa.Integer(), nullable=False, comment="that count"),
        sa.Column("ap_r40", sa.Float(precision=53), nullable=True, comment="percent"),
        sa.Column("ap_r11", sa.Float(precision=53), nullable=True, comment="percent"),
        sa.PrimaryKeyConstraint(
            "source", "category", "figure", "difficulty", name=op.f("pk_evaluation_ap")
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "evaluation_object",
        sa.Column(
            "source",
            sa.Text(),
            nullable=False,
            comment="whose detections: e.g. round 1, or a checkpoint's path",
        ),
        sa.Column("frame_id", sa.Integer(), nullable=False),
        sa.Column("side", sa.Text(), nullable=False, comment="object | detection"),
        sa.Column(
            "k",
            sa.Integer(),
            autoincrement=False,
            nullable=False,
            comment="of ground_truth or of prediction",
        ),
        sa.Column(
            "category",
            sa.Text(),
            nullable=False,
            comment="under evaluation; a Van is an ignored object of Car",
        ),
        sa.Column("outcome", sa.Text(), nullable=False, comment="tp | fp | fn | ignored"),
        sa.Column("matched_k", sa.Integer(), nullable=True, comment="of the other side"),
        sa.Column(
            "iou",
            sa.Float(precision=53),
            nullable=False,
            comment="with the match, else the greatest with any that took part",
        ),
        sa.Column(
            "score",
            sa.Float(precision=53),
            nullable=True,
            comment="of the detection, for objects of the matched one",
        ),
        sa.Column("overlap", sa.Text(), nullable=False, comment="what iou is: image | bev | 3d"),
        sa.Column("difficulty", sa.Text(), nullable=False, comment="objects beyond it are ignored"),
        sa.Column("x", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("y", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("z", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("length", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("width", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("height", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("yaw", sa.Float(precision=53), nullable=False, comment="radians, (-pi, pi]"),
        sa.CheckConstraint(
            "outcome IN ('tp', 'fp', 'fn', 'ignored')", name=op.f("ck_evaluation_object_outcome")
        ),
        sa.CheckConstraint(
            "side IN ('object', 'detection')", name=op.f("ck_evaluation_object_side")
        ),
        sa.ForeignKeyConstraint(
            ["frame_id"], ["frame.id"], name=op.f("fk_evaluation_object_frame_id")
        ),
        sa.PrimaryKeyConstraint(
            "source", "frame_id", "side", "k", "category", name=op.f("pk_evaluation_object")
        ),
        sqlite_with_rowid=False,
    )
    with op.batch_alter_table("evaluation_object", schema=None) as batch_op:
        batch_op.create_index("ix_evaluation_object_outcome", ["source", "outcome"], unique=False)


def downgrade() -> None:
    """Goes back."""
    with op.batch_alter_table("evaluation_object", schema=None) as batch_op:
        batch_op.drop_index("ix_evaluation_object_outcome")

    op.drop_table("evaluation_object")
    op.drop_table("evaluation_ap")
    op.drop_table("audit_slice")
    op.drop_table("audit_bin")
    op.drop_table("audit")
