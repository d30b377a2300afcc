"""The tables of section 3."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Goes forward."""
    op.create_table(
        "checkpoint",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column(
            "round",
            sa.Integer(),
            nullable=False,
            comment="the round that made it; 0 before the first",
        ),
        sa.Column(
            "policy",
            sa.Text(),
            nullable=False,
            comment="whose weights it learned from; '' for round 0",
        ),
        sa.Column("detector", sa.Text(), nullable=False),
        sa.Column(
            "path", sa.Text(), nullable=False, comment="relative to the workspace, or absolute"
        ),
        sa.Column("sha256", sa.Text(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_checkpoint")),
        sa.UniqueConstraint("round", "policy", name=op.f("uq_checkpoint_round_policy")),
    )
    op.create_table(
        "frame",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("dataset", sa.Text(), nullable=False),
        sa.Column("frame", sa.Text(), nullable=False, comment="frame id within the data set"),
        sa.Column("split", sa.Text(), nullable=False, comment="labeled | unlabeled | val"),
        sa.Column(
            "points_path", sa.Text(), nullable=False, comment="relative to the data set's root"
        ),
        sa.Column(
            "image_path", sa.Text(), nullable=False, comment="relative to the data set's root"
        ),
        sa.Column(
            "calibration_path", sa.Text(), nullable=False, comment="relative to the data set's root"
        ),
        sa.Column(
            "label_path",
            sa.Text(),
            nullable=True,
            comment="relative to the data set's root; never for unlabeled frames",
        ),
        sa.CheckConstraint(
            "split <> 'unlabeled' OR label_path IS NULL",
            name=op.f("ck_frame_unlabeled_has_no_label"),
        ),
        sa.CheckConstraint("split IN ('labeled', 'unlabeled', 'val')", name=op.f("ck_frame_split")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_frame")),
        sa.UniqueConstraint("dataset", "frame", name=op.f("uq_frame_dataset_frame")),
        sa.UniqueConstraint("id", "split", name=op.f("uq_frame_id_split")),
    )
    op.create_table(
        "ground_truth",
        sa.Column("frame_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("k", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("split", sa.Text(), nullable=False),
        sa.Column("category", sa.Text(), nullable=False),
        sa.Column("x", sa.Float(precision=53), nullable=True, comment="metres, LiDAR frame"),
        sa.Column("y", sa.Float(precision=53), nullable=True, comment="metres, LiDAR frame"),
        sa.Column("z", sa.Float(precision=53), nullable=True, comment="metres, LiDAR frame"),
        sa.Column("length", sa.Float(precision=53), nullable=True, comment="metres, LiDAR frame"),
        sa.Column("width", sa.Float(precision=53), nullable=True, comment="metres, LiDAR frame"),
        sa.Column("height", sa.Float(precision=53), nullable=True, comment="metres, LiDAR frame"),
        sa.Column("yaw", sa.Float(precision=53), nullable=True, comment="radians, (-pi, pi]"),
        sa.Column("truncated", sa.Float(precision=53), nullable=False, comment="0 to 1"),
        sa.Column("occluded", sa.Integer(), nullable=False, comment="KITTI's levels 0 to 3"),
        sa.Column("alpha", sa.Float(precision=53), nullable=False, comment="radians, (-pi, pi]"),
        sa.Column("image_left", sa.Float(precision=53), nullable=False, comment="pixels"),
        sa.Column("image_top", sa.Float(precision=53), nullable=False, comment="pixels"),
        sa.Column("image_right", sa.Float(precision=53), nullable=False, comment="pixels"),
        sa.Column("image_bottom", sa.Float(precision=53), nullable=False, comment="pixels"),
        sa.CheckConstraint(
            "split IN ('labeled', 'val')", name=op.f("ck_ground_truth_never_unlabeled")
        ),
        sa.ForeignKeyConstraint(
            ["frame_id", "split"],
            ["frame.id", "frame.split"],
            name=op.f("fk_ground_truth_frame_id_split"),
        ),
        sa.PrimaryKeyConstraint("frame_id", "k", name=op.f("pk_ground_truth")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "round",
        sa.Column("number", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("rounds", sa.Integer(), nullable=False, comment="E: e/E is the age of Eq. 4"),
        sa.Column("teacher_id", sa.Integer(), nullable=True),
        sa.Column("config", sa.Text(), nullable=False, comment="the whole configuration, JSON"),
        sa.Column("code_version", sa.Text(), nullable=False),
        sa.Column("seed", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["teacher_id"], ["checkpoint.id"], name=op.f("fk_round_teacher_id")
        ),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_round")),
    )
    op.create_table(
        "task",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("round", sa.Integer(), nullable=False),
        sa.Column("stage", sa.Text(), nullable=False),
        sa.Column(
            "variant",
            sa.Text(),
            nullable=False,
            comment="policy or format of a round stage, else ''",
        ),
        sa.Column("frame_id", sa.Integer(), nullable=True),
        sa.Column(
            "fingerprint", sa.Text(), nullable=False, comment="of all that the result depends on"
        ),
        sa.Column("state", sa.Text(), nullable=False, comment="done | empty | failed"),
        sa.Column("error", sa.Text(), nullable=True),
        sa.Column("seconds", sa.Float(precision=53), nullable=False),
        sa.CheckConstraint(
            "(state = 'failed') = (error IS NOT NULL)", name=op.f("ck_task_error_iff_failed")
        ),
        sa.CheckConstraint("state IN ('done', 'empty', 'failed')", name=op.f("ck_task_state")),
        sa.ForeignKeyConstraint(["frame_id"], ["frame.id"], name=op.f("fk_task_frame_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_task")),
    )
    with op.batch_alter_table("task", schema=None) as batch_op:
        batch_op.create_index(
            "uq_task_frame",
            ["round", "stage", "frame_id"],
            unique=True,
            sqlite_where=sa.text("frame_id IS NOT NULL"),
            postgresql_where=sa.text("frame_id IS NOT NULL"),
        )
        batch_op.create_index(
            "uq_task_round",
            ["round", "stage", "variant"],
            unique=True,
            sqlite_where=sa.text("frame_id IS NULL"),
            postgresql_where=sa.text("frame_id IS NULL"),
        )

    op.create_table(
        "prediction",
        sa.Column("round", sa.Integer(), nullable=False),
        sa.Column("frame_id", sa.Integer(), nullable=False),
        sa.Column("k", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("category", sa.Text(), nullable=False),
        sa.Column("score", sa.Float(precision=53), nullable=False, comment="0 to 1"),
        sa.Column("x", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("y", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("z", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("length", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("width", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("height", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("yaw", sa.Float(precision=53), nullable=False, comment="radians, (-pi, pi]"),
        sa.ForeignKeyConstraint(["frame_id"], ["frame.id"], name=op.f("fk_prediction_frame_id")),
        sa.ForeignKeyConstraint(["round"], ["round.number"], name=op.f("fk_prediction_round")),
        sa.PrimaryKeyConstraint("round", "frame_id", "k", name=op.f("pk_prediction")),
        sqlite_with_rowid=False,
    )
    with op.batch_alter_table("prediction", schema=None) as batch_op:
        batch_op.create_index(
            "ix_prediction_category_score", ["round", "category", "score"], unique=False
        )

    op.create_table(
        "reprediction_view",
        sa.Column("round", sa.Integer(), nullable=False),
        sa.Column("frame_id", sa.Integer(), nullable=False),
        sa.Column("view", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("flip_y", sa.Integer(), nullable=False, comment="1 if y was mirrored, first"),
        sa.Column(
            "rotation_rad",
            sa.Float(precision=53),
            nullable=False,
            comment="about z, radians, second",
        ),
        sa.Column(
            "scale", sa.Float(precision=53), nullable=False, comment="of all coordinates, third"
        ),
        sa.ForeignKeyConstraint(
            ["frame_id"], ["frame.id"], name=op.f("fk_reprediction_view_frame_id")
        ),
        sa.ForeignKeyConstraint(
            ["round"], ["round.number"], name=op.f("fk_reprediction_view_round")
        ),
        sa.PrimaryKeyConstraint("round", "frame_id", "view", name=op.f("pk_reprediction_view")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "consistency",
        sa.Column("round", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("frame_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("k", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column(
            "loss", sa.Float(precision=53), nullable=True, comment="L; null = no match, no evidence"
        ),
        sa.Column("views", sa.Integer(), nullable=False),
        sa.Column("matched_views", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["round", "frame_id", "k"],
            ["prediction.round", "prediction.frame_id", "prediction.k"],
            name=op.f("fk_consistency_round_frame_id_k"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("round", "frame_id", "k", name=op.f("pk_consistency")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "point_prior",
        sa.Column("round", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("frame_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("k", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("points", sa.Integer(), nullable=False, comment="m"),
        sa.Column(
            "points_threshold",
            sa.Float(precision=53),
            nullable=False,
            comment="m_th of the category",
        ),
        sa.Column("rho_diff", sa.Float(precision=53), nullable=False, comment="0 to 1"),
        sa.ForeignKeyConstraint(
            ["round", "frame_id", "k"],
            ["prediction.round", "prediction.frame_id", "prediction.k"],
            name=op.f("fk_point_prior_round_frame_id_k"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("round", "frame_id", "k", name=op.f("pk_point_prior")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "reprediction",
        sa.Column("round", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("frame_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("view", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column(
            "k", sa.Integer(), autoincrement=False, nullable=False, comment="number within the view"
        ),
        sa.Column("category", sa.Text(), nullable=False),
        sa.Column("score", sa.Float(precision=53), nullable=False, comment="0 to 1"),
        sa.Column(
            "matched_k", sa.Integer(), nullable=True, comment="prediction.k; null = no match"
        ),
        sa.Column("iou", sa.Float(precision=53), nullable=True, comment="BEV IoU of the match"),
        sa.Column("score_loss", sa.Float(precision=53), nullable=True, comment="-ln of this score"),
        sa.Column(
            "box_loss", sa.Float(precision=53), nullable=True, comment="sum of smooth L1, beta 1/9"
        ),
        sa.Column("x", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("y", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("z", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("length", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("width", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("height", sa.Float(precision=53), nullable=False, comment="metres, LiDAR frame"),
        sa.Column("yaw", sa.Float(precision=53), nullable=False, comment="radians, (-pi, pi]"),
        sa.ForeignKeyConstraint(
            ["round", "frame_id", "view"],
            ["reprediction_view.round", "reprediction_view.frame_id", "reprediction_view.view"],
            name=op.f("fk_reprediction_round_frame_id_view"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("round", "frame_id", "view", "k", name=op.f("pk_reprediction")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "semantic_prior",
        sa.Column("round", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("frame_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("k", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("mask_pixels", sa.Integer(), nullable=False, comment="S"),
        sa.Column("box_pixels", sa.Integer(), nullable=False, comment="A; 0 = outside the image"),
        sa.Column("rho_anno", sa.Float(precision=53), nullable=False, comment="0 to 1"),
        sa.ForeignKeyConstraint(
            ["round", "frame_id", "k"],
            ["prediction.round", "prediction.frame_id", "prediction.k"],
            name=op.f("fk_semantic_prior_round_frame_id_k"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("round", "frame_id", "k", name=op.f("pk_semantic_prior")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "weight",
        sa.Column("round", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("frame_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("k", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("policy", sa.Text(), nullable=False),
        sa.Column(
            "lambda_u", sa.Float(precision=53), nullable=True, comment="Eq. 4; null where unused"
        ),
        sa.Column(
            "rho_det", sa.Float(precision=53), nullable=True, comment="product of the priors"
        ),
        sa.Column("v", sa.Float(precision=53), nullable=False, comment="0 to 1"),
        sa.ForeignKeyConstraint(
            ["round", "frame_id", "k"],
            ["prediction.round", "prediction.frame_id", "prediction.k"],
            name=op.f("fk_weight_round_frame_id_k"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("round", "frame_id", "k", "policy", name=op.f("pk_weight")),
        sqlite_with_rowid=False,
    )
    with op.batch_alter_table("weight", schema=None) as batch_op:
        batch_op.create_index("ix_weight_policy_v", ["round", "policy", "v"], unique=False)
    if op.get_bind().dialect.name == "sqlite":
        # The foreign key already refuses it; this holds for connections that switched keys off too.
        op.execute(
            """
            CREATE TRIGGER ground_truth_never_unlabeled BEFORE INSERT ON ground_truth
            WHEN (SELECT split FROM frame WHERE id = NEW.frame_id) = 'unlabeled'
            BEGIN SELECT RAISE(ABORT, 'ground truth of an unlabeled frame'); END
            """
        )


def downgrade() -> None:
    """Goes back."""
    with op.batch_alter_table("weight", schema=None) as batch_op:
        batch_op.drop_index("ix_weight_policy_v")

    op.drop_table("weight")
    op.drop_table("semantic_prior")
    op.drop_table("reprediction")
    op.drop_table("point_prior")
    op.drop_table("consistency")
    op.drop_table("reprediction_view")
    with op.batch_alter_table("prediction", schema=None) as batch_op:
        batch_op.drop_index("ix_prediction_category_score")

    op.drop_table("prediction")
    with op.batch_alter_table("task", schema=None) as batch_op:
        batch_op.drop_index(
            "uq_task_round",
            sqlite_where=sa.text("frame_id IS NULL"),
            postgresql_where=sa.text("frame_id IS NULL"),
        )
        batch_op.drop_index(
            "uq_task_frame",
            sqlite_where=sa.text("frame_id IS NOT NULL"),
            postgresql_where=sa.text("frame_id IS NOT NULL"),
        )

    op.drop_table("task")
    op.drop_table("round")
    op.drop_table("ground_truth")
    op.drop_table("frame")
    op.drop_table("checkpoint")
