"""The tables of curate, in pipeline order.

Boxes are x, y, z of the centre, length, width, height in metres and yaw in radians in the LiDAR
frame. Everything that a stage found out about label k of a frame carries the same key
(round, frame_id, k), so evidence joins without a thought and leaves with its prediction.
"""

from datetime import datetime
from typing import Annotated, Any, ClassVar

from sqlalchemy import (
    CheckConstraint,
    DateTime,
    Float,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    MetaData,
    Text,
    UniqueConstraint,
    text,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

BOX_COLUMNS = ("x", "y", "z", "length", "width", "height", "yaw")
RECTANGLE_COLUMNS = ("image_left", "image_top", "image_right", "image_bottom")

# `comment` is stored in the database, `doc` is not and replaces it in the descriptions that
# `pipelines.queries.schema` makes; `info["unit"]` is the unit.
Key = Annotated[int, mapped_column(primary_key=True, autoincrement=False)]
Metres = Annotated[float, mapped_column(comment="metres, LiDAR frame", info={"unit": "m"})]
Radians = Annotated[float, mapped_column(comment="radians, (-pi, pi]", info={"unit": "rad"})]
Pixels = Annotated[float, mapped_column(comment="pixels", info={"unit": "px"})]
Share = Annotated[float, mapped_column(comment="0 to 1", info={"unit": "1"})]
Bound = Annotated[float | None, mapped_column(comment="bound of its interval")]


class Base(DeclarativeBase):
    """Root of the models."""

    type_annotation_map: ClassVar = {str: Text, float: Float(53)}

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s",
            "pk": "pk_%(table_name)s",
        }
    )


class Box:
    """The seven numbers of a box."""

    x: Mapped[Metres] = mapped_column(doc="box centre, forward of the LiDAR")
    y: Mapped[Metres] = mapped_column(doc="box centre, to the left of the LiDAR")
    z: Mapped[Metres] = mapped_column(doc="box centre, above the LiDAR")
    length: Mapped[Metres] = mapped_column(doc="along the heading")
    width: Mapped[Metres] = mapped_column(doc="across the heading")
    height: Mapped[Metres] = mapped_column(doc="upward")
    yaw: Mapped[Radians] = mapped_column(doc="counter-clockwise from x, in (-pi, pi]")


def _evidence(*more: Any) -> tuple[Any, ...]:
    """Keys of a table whose rows belong to a prediction and leave with it."""
    key = ForeignKeyConstraint(
        ["round", "frame_id", "k"],
        ["prediction.round", "prediction.frame_id", "prediction.k"],
        ondelete="CASCADE",
    )
    return (key, *more, {"sqlite_with_rowid": False})


class Frame(Base):
    """A LiDAR-camera frame and the split that it belongs to."""

    __tablename__ = "frame"
    __table_args__ = (
        UniqueConstraint("dataset", "frame"),
        UniqueConstraint("id", "split"),
        Index("ix_frame_frame", "frame"),
        CheckConstraint("split IN ('labeled', 'unlabeled', 'val')", name="split"),
        CheckConstraint(
            "split <> 'unlabeled' OR label_path IS NULL", name="unlabeled_has_no_label"
        ),
    )

    id: Mapped[int] = mapped_column(primary_key=True, doc="key of the row in this database")
    dataset: Mapped[str] = mapped_column(doc="kind of the data set, as in curate.toml")
    frame: Mapped[str] = mapped_column(comment="frame id within the data set")
    split: Mapped[str] = mapped_column(comment="labeled | unlabeled | val")
    points_path: Mapped[str] = mapped_column(comment="relative to the data set's root")
    image_path: Mapped[str] = mapped_column(comment="relative to the data set's root")
    calibration_path: Mapped[str] = mapped_column(comment="relative to the data set's root")
    label_path: Mapped[str | None] = mapped_column(
        comment="relative to the data set's root; never for unlabeled frames"
    )


class SplitList(Base):
    """The lists of frames as `curate init` found and chose them; the firewall compares."""

    __tablename__ = "split_list"
    __table_args__ = ({"sqlite_with_rowid": False},)

    source: Mapped[str] = mapped_column(
        primary_key=True, comment="chosen | dataset (its own) | file (given to init)"
    )
    name: Mapped[str] = mapped_column(
        primary_key=True, comment="labeled | unlabeled | val, or of the data set's list"
    )
    path: Mapped[str | None] = mapped_column(comment="of the file")
    frames: Mapped[int] = mapped_column(comment="how many")
    sha256: Mapped[str] = mapped_column(comment="of names")
    names: Mapped[str] = mapped_column(comment="the sorted names, one per line")


class GroundTruth(Base):
    """What annotators wrote, for labeled and val frames only.

    The key holds the frame's split as well, so a row for an unlabeled frame cannot exist.
    """

    __tablename__ = "ground_truth"
    __table_args__ = (
        ForeignKeyConstraint(["frame_id", "split"], ["frame.id", "frame.split"]),
        CheckConstraint("split IN ('labeled', 'val')", name="never_unlabeled"),
        {"sqlite_with_rowid": False},
    )

    frame_id: Mapped[Key] = mapped_column(doc="frame.id")
    k: Mapped[Key] = mapped_column(doc="number of the object within its frame")
    split: Mapped[str] = mapped_column(doc="labeled | val")
    category: Mapped[str] = mapped_column(doc="of the object")
    x: Mapped[Metres | None] = mapped_column(doc="box centre, forward of the LiDAR")
    y: Mapped[Metres | None] = mapped_column(doc="box centre, to the left of the LiDAR")
    z: Mapped[Metres | None] = mapped_column(doc="box centre, above the LiDAR")
    length: Mapped[Metres | None] = mapped_column(doc="along the heading")
    width: Mapped[Metres | None] = mapped_column(doc="across the heading")
    height: Mapped[Metres | None] = mapped_column(doc="upward")
    yaw: Mapped[Radians | None] = mapped_column(doc="counter-clockwise from x, in (-pi, pi]")
    truncated: Mapped[Share] = mapped_column(doc="share of the object outside the image, 0 to 1")
    occluded: Mapped[int] = mapped_column(comment="KITTI's levels 0 to 3")
    alpha: Mapped[Radians] = mapped_column(doc="KITTI's observation angle, in (-pi, pi]")
    image_left: Mapped[Pixels] = mapped_column(doc="left edge of the rectangle in the image")
    image_top: Mapped[Pixels] = mapped_column(doc="top edge of the rectangle in the image")
    image_right: Mapped[Pixels] = mapped_column(doc="right edge of the rectangle in the image")
    image_bottom: Mapped[Pixels] = mapped_column(doc="bottom edge of the rectangle in the image")


class Checkpoint(Base):
    """A trained detector, or the one that the user brought."""

    __tablename__ = "checkpoint"
    __table_args__ = (UniqueConstraint("round", "policy"),)

    id: Mapped[int] = mapped_column(primary_key=True, doc="key of the row")
    round: Mapped[int] = mapped_column(comment="the round that made it; 0 before the first")
    policy: Mapped[str] = mapped_column(comment="whose weights it learned from; '' for round 0")
    detector: Mapped[str] = mapped_column(doc="as in curate.toml")
    path: Mapped[str] = mapped_column(comment="relative to the workspace, or absolute")
    sha256: Mapped[str] = mapped_column(doc="of the file")
    created_at: Mapped[datetime] = mapped_column(DateTime(timezone=True), doc="time in UTC")


class TrainingStatistics(Base):
    """The curves of a training: loss terms, learning rate and gradient norm of every few steps."""

    __tablename__ = "training_statistics"
    __table_args__ = ({"sqlite_with_rowid": False},)

    round: Mapped[int] = mapped_column(
        primary_key=True, autoincrement=False, comment="as of the checkpoint"
    )
    policy: Mapped[str] = mapped_column(primary_key=True, comment="as of the checkpoint")
    step: Mapped[int] = mapped_column(
        primary_key=True, autoincrement=False, comment="of the optimiser, from 1"
    )
    name: Mapped[str] = mapped_column(
        primary_key=True, comment="loss, a term of it, learning_rate or gradient_norm"
    )
    value: Mapped[float | None] = mapped_column(comment="of this step alone; null = not finite")


class Round(Base):
    """One round e of E: the teacher's answers, their evidence, their weights, the student."""

    __tablename__ = "round"

    number: Mapped[Key] = mapped_column(doc="e, from 1")
    rounds: Mapped[int] = mapped_column(comment="E: e/E is the age of Eq. 4")
    teacher_id: Mapped[int | None] = mapped_column(
        ForeignKey("checkpoint.id"), doc="checkpoint.id of the detector that predicts"
    )
    config: Mapped[str] = mapped_column(comment="the whole configuration, JSON")
    code_version: Mapped[str] = mapped_column(doc="of curate")
    seed: Mapped[int] = mapped_column(doc="of all random draws of the round")


class Prediction(Box, Base):
    """Label k of a frame: one box of f(x; w)."""

    __tablename__ = "prediction"
    __table_args__ = (
        Index("ix_prediction_category_score", "round", "category", "score"),
        {"sqlite_with_rowid": False},
    )

    round: Mapped[int] = mapped_column(
        ForeignKey("round.number"), primary_key=True, doc="round.number"
    )
    frame_id: Mapped[int] = mapped_column(ForeignKey("frame.id"), primary_key=True, doc="frame.id")
    k: Mapped[Key] = mapped_column(doc="number of the label within its frame, by falling score")
    category: Mapped[str] = mapped_column(doc="of the object")
    score: Mapped[Share] = mapped_column(doc="s of the detector, 0 to 1")
    iou: Mapped[float | None] = mapped_column(
        sort_order=1,
        comment="the detector's estimate of its 3D IoU with the object; null = it makes none",
    )


class RepredictionView(Base):
    """The similarity A of one augmented view of a frame."""

    __tablename__ = "reprediction_view"
    __table_args__ = ({"sqlite_with_rowid": False},)

    round: Mapped[int] = mapped_column(
        ForeignKey("round.number"), primary_key=True, doc="round.number"
    )
    frame_id: Mapped[int] = mapped_column(ForeignKey("frame.id"), primary_key=True, doc="frame.id")
    view: Mapped[Key] = mapped_column(doc="number of the view, from 0")
    flip_y: Mapped[int] = mapped_column(comment="1 if y was mirrored, first")
    rotation_rad: Mapped[float] = mapped_column(
        comment="about z, radians, second", info={"unit": "rad"}
    )
    scale: Mapped[float] = mapped_column(comment="of all coordinates, third")


class Reprediction(Box, Base):
    """One box of A^-1 f(A(x); w), and the prediction that it was matched with."""

    __tablename__ = "reprediction"
    __table_args__ = (
        ForeignKeyConstraint(
            ["round", "frame_id", "view"],
            ["reprediction_view.round", "reprediction_view.frame_id", "reprediction_view.view"],
            ondelete="CASCADE",
        ),
        {"sqlite_with_rowid": False},
    )

    round: Mapped[Key] = mapped_column(doc="round.number")
    frame_id: Mapped[Key] = mapped_column(doc="frame.id")
    view: Mapped[Key] = mapped_column(doc="reprediction_view.view")
    k: Mapped[int] = mapped_column(
        primary_key=True, autoincrement=False, comment="number within the view"
    )
    category: Mapped[str] = mapped_column(doc="of the object")
    score: Mapped[Share] = mapped_column(doc="s' of the detector, 0 to 1")
    matched_k: Mapped[int | None] = mapped_column(comment="prediction.k; null = no match")
    iou: Mapped[float | None] = mapped_column(comment="BEV IoU of the match")
    score_loss: Mapped[float | None] = mapped_column(comment="-ln of this score")
    box_loss: Mapped[float | None] = mapped_column(comment="sum of smooth L1, beta 1/9")


class Consistency(Base):
    """The consistency loss L of a prediction, the mean over the views that matched."""

    __tablename__ = "consistency"
    __table_args__ = _evidence()

    round: Mapped[Key] = mapped_column(doc="prediction.round")
    frame_id: Mapped[Key] = mapped_column(doc="prediction.frame_id")
    k: Mapped[Key] = mapped_column(doc="prediction.k")
    loss: Mapped[float | None] = mapped_column(comment="L; null = no match, no evidence")
    views: Mapped[int] = mapped_column(doc="augmented views of the frame")
    matched_views: Mapped[int] = mapped_column(doc="views with a matched reprediction")


class PointPrior(Base):
    """Eq. 8: LiDAR points inside the box against those inside labeled boxes."""

    __tablename__ = "point_prior"
    __table_args__ = _evidence()

    round: Mapped[Key] = mapped_column(doc="prediction.round")
    frame_id: Mapped[Key] = mapped_column(doc="prediction.frame_id")
    k: Mapped[Key] = mapped_column(doc="prediction.k")
    points: Mapped[int] = mapped_column(comment="m")
    points_threshold: Mapped[float] = mapped_column(comment="m_th of the category")
    rho_diff: Mapped[Share] = mapped_column(doc="trust in [0, 1], Eq. 8")


class SemanticPrior(Base):
    """Eq. 9: pixels of the category's classes inside the projected box."""

    __tablename__ = "semantic_prior"
    __table_args__ = _evidence()

    round: Mapped[Key] = mapped_column(doc="prediction.round")
    frame_id: Mapped[Key] = mapped_column(doc="prediction.frame_id")
    k: Mapped[Key] = mapped_column(doc="prediction.k")
    mask_pixels: Mapped[int] = mapped_column(comment="S")
    box_pixels: Mapped[int] = mapped_column(comment="A; 0 = outside the image")
    rho_anno: Mapped[Share] = mapped_column(doc="trust in [0, 1], Eq. 9")


class EvidenceSource(Base):
    """What an evidence source has declared that has a table `prior_NAME` of its own."""

    __tablename__ = "evidence_source"
    __table_args__ = ({"sqlite_with_rowid": False},)

    name: Mapped[str] = mapped_column(primary_key=True, comment="its table is prior_NAME")
    source: Mapped[str] = mapped_column(comment="as run.priors names it")
    columns: Mapped[str] = mapped_column(
        comment="JSON: name, kind, unit, meaning and optional of each"
    )
    rho_column: Mapped[str | None] = mapped_column(
        comment="the column with its trust in [0, 1]; null = not a prior"
    )


class Weight(Base):
    """The reliability weight v that one policy gives a label; policies stand side by side.

    What v = 0 means is a member of the policy: background, or ignored where the policy has a band
    of doubt. A label that a policy drops has no row of that policy. Each policy has an index by
    value of its own, see `db.weight_index`.
    """

    __tablename__ = "weight"
    __table_args__ = _evidence()

    round: Mapped[Key] = mapped_column(doc="prediction.round")
    frame_id: Mapped[Key] = mapped_column(doc="prediction.frame_id")
    k: Mapped[Key] = mapped_column(doc="prediction.k")
    policy: Mapped[str] = mapped_column(primary_key=True, doc="that gave the weight")
    lambda_u: Mapped[float | None] = mapped_column(comment="Eq. 4; null where unused")
    rho_det: Mapped[float | None] = mapped_column(comment="product of the priors")
    v: Mapped[Share] = mapped_column(doc="weight in [0, 1]; what 0 means, the policy says")


class LabelCount(Base):
    """How many labels a policy has weighed in a round; written by solve together with `weight`.

    Counting millions of them anew would take seconds.
    """

    __tablename__ = "label_count"
    __table_args__ = ({"sqlite_with_rowid": False},)

    round: Mapped[int] = mapped_column(
        ForeignKey("round.number"), primary_key=True, doc="round.number"
    )
    policy: Mapped[str] = mapped_column(primary_key=True, doc="that weighted the labels")
    category: Mapped[str] = mapped_column(primary_key=True, doc="of the labels")
    labels: Mapped[int] = mapped_column(comment="that the policy did not drop")
    kept: Mapped[int] = mapped_column(comment="with a weight above 0")
    trusted: Mapped[int] = mapped_column(comment="with a weight above 0.5")
    weight: Mapped[float] = mapped_column(comment="sum of the weights")


class Review(Base):
    """Labels that were handed to an editor, and when the answer was taken back."""

    __tablename__ = "review"

    id: Mapped[str] = mapped_column(primary_key=True, comment="hash of its manifest")
    round: Mapped[int] = mapped_column(comment="whose labels")
    policy: Mapped[str] = mapped_column(comment="whose weights chose them")
    editor: Mapped[str] = mapped_column(comment="kitti | labelcloud | cvat")
    frames: Mapped[int] = mapped_column(doc="frames that were exported")
    boxes: Mapped[int] = mapped_column(comment="in all, those for context included")
    asked: Mapped[int] = mapped_column(comment="of the boxes")
    exported_at: Mapped[str] = mapped_column(comment="ISO 8601, UTC")
    imported_at: Mapped[str | None] = mapped_column(comment="ISO 8601, UTC; null = not yet")


class HumanLabel(Box, Base):
    """What a person decided about an object of an unlabeled frame; it counts in later rounds too.

    The key holds the frame's split as well, so a row for a labeled or val frame cannot exist. The
    box is the object's; of a rejected label the one that was refused.
    """

    __tablename__ = "human_label"
    __table_args__ = (
        ForeignKeyConstraint(["frame_id", "split"], ["frame.id", "frame.split"]),
        CheckConstraint("split = 'unlabeled'", name="only_unlabeled"),
        CheckConstraint("decision IN ('accepted', 'rejected', 'moved', 'added')", name="decision"),
        Index("ix_human_label_review", "review"),
        {"sqlite_with_rowid": False},
    )

    frame_id: Mapped[Key] = mapped_column(doc="frame.id")
    n: Mapped[Key] = mapped_column(doc="number of the decision within its frame")
    split: Mapped[str] = mapped_column(doc="always unlabeled")
    review: Mapped[str] = mapped_column(ForeignKey("review.id"), doc="review.id")
    item: Mapped[int | None] = mapped_column(
        comment="number of the box in the review; null = added"
    )
    decision: Mapped[str] = mapped_column(comment="accepted | rejected | moved | added")
    category: Mapped[str] = mapped_column(doc="of the object")
    from_round: Mapped[int] = mapped_column(comment="it counts in this round and later")
    seen_x: Mapped[float | None] = mapped_column(
        sort_order=1,
        comment="metres, LiDAR frame: the box as it was shown; null = none",
        doc="of the box as it was shown; null = none",
        info={"unit": "m"},
    )
    seen_y: Mapped[Metres | None] = mapped_column(sort_order=1, doc="of the box as it was shown")
    seen_z: Mapped[Metres | None] = mapped_column(sort_order=1, doc="of the box as it was shown")
    seen_length: Mapped[Metres | None] = mapped_column(
        sort_order=1, doc="of the box as it was shown"
    )
    seen_width: Mapped[Metres | None] = mapped_column(
        sort_order=1, doc="of the box as it was shown"
    )
    seen_height: Mapped[Metres | None] = mapped_column(
        sort_order=1, doc="of the box as it was shown"
    )
    seen_yaw: Mapped[Radians | None] = mapped_column(sort_order=1, doc="of the box as it was shown")
    reviewer: Mapped[str] = mapped_column(sort_order=2, comment="who decided")
    decided_at: Mapped[str] = mapped_column(sort_order=2, comment="ISO 8601, UTC")


class HumanMatch(Base):
    """A prediction that a human label speaks for, so that no object is labeled twice.

    A rejected one weighs 0 whatever a policy says; others give way to the human label's own box.
    """

    __tablename__ = "human_match"
    __table_args__ = _evidence(
        ForeignKeyConstraint(
            ["frame_id", "n"], ["human_label.frame_id", "human_label.n"], ondelete="CASCADE"
        ),
        Index("ix_human_match_label", "frame_id", "n"),
    )

    round: Mapped[Key] = mapped_column(doc="prediction.round")
    frame_id: Mapped[Key] = mapped_column(doc="prediction.frame_id")
    k: Mapped[Key] = mapped_column(doc="prediction.k")
    n: Mapped[int] = mapped_column(comment="human_label.n")
    iou: Mapped[float] = mapped_column(comment="BEV IoU with its box, or the one seen")
    leads: Mapped[int] = mapped_column(
        comment="1 if the human label stands in weighted_labels under this k"
    )


class _Audited:
    """The key of a row of an audit."""

    round: Mapped[int] = mapped_column(primary_key=True, sort_order=-1, comment="of the teacher")
    frames: Mapped[str] = mapped_column(
        primary_key=True, sort_order=-1, comment="which: val, labeled, or e.g. 5 folds"
    )
    overlap: Mapped[str] = mapped_column(primary_key=True, sort_order=-1, comment="bev | 3d")
    policy: Mapped[str] = mapped_column(
        primary_key=True,
        sort_order=-1,
        comment="or score, rho_det, consistency: evidence by itself",
    )
    category: Mapped[str] = mapped_column(primary_key=True, sort_order=-1, comment="or 'all'")


class _Judgement:
    """What is said of the labels of an audit; every figure is null where it is undefined."""

    labels: Mapped[int] = mapped_column(comment="that are right or wrong")
    neutral: Mapped[int] = mapped_column(comment="further labels that are neither")
    right_labels: Mapped[int] = mapped_column(comment="of the labels")
    objects: Mapped[int | None] = mapped_column(comment="to be found; null = unknown")
    share_right: Mapped[float | None] = mapped_column(doc="right_labels / labels")
    share_right_low: Mapped[Bound]
    share_right_high: Mapped[Bound]
    auroc: Mapped[float | None] = mapped_column(
        comment="chance that a right label weighs more than a wrong one"
    )
    auroc_low: Mapped[Bound]
    auroc_high: Mapped[Bound]
    average_precision: Mapped[float | None] = mapped_column(
        comment="of the labels ranked by weight"
    )
    average_precision_low: Mapped[Bound]
    average_precision_high: Mapped[Bound]
    weighted_precision: Mapped[float | None] = mapped_column(
        comment="share of the weight that lies on right labels"
    )
    weighted_precision_low: Mapped[Bound]
    weighted_precision_high: Mapped[Bound]
    weighted_recall: Mapped[float | None] = mapped_column(
        comment="weight on right labels per object"
    )
    weighted_recall_low: Mapped[Bound]
    weighted_recall_high: Mapped[Bound]
    calibration_error: Mapped[float | None] = mapped_column(
        comment="expected distance of weight and share of right labels"
    )
    calibration_error_low: Mapped[Bound]
    calibration_error_high: Mapped[Bound]


class Audit(_Audited, _Judgement, Base):
    """How well a policy's weight tells right labels from wrong ones, on frames with ground truth.

    The frames were treated as if they were unlabeled. Intervals are of 95 %, over frames.
    """

    __tablename__ = "audit"
    __table_args__ = ({"sqlite_with_rowid": False},)


class AuditSlice(_Audited, _Judgement, Base):
    """The same for a range of distances from the LiDAR, or of LiDAR points in the label."""

    __tablename__ = "audit_slice"
    __table_args__ = ({"sqlite_with_rowid": False},)

    kind: Mapped[str] = mapped_column(primary_key=True, comment="distance | points")
    low: Mapped[float] = mapped_column(primary_key=True, comment="metres or points, included")
    high: Mapped[float | None] = mapped_column(
        comment="metres or points, not included; null = open"
    )


class AuditBin(_Audited, Base):
    """The labels of an audit whose weight lies in a bin; the last bin holds its upper edge."""

    __tablename__ = "audit_bin"
    __table_args__ = ({"sqlite_with_rowid": False},)

    low: Mapped[float] = mapped_column(primary_key=True, comment="weight, included")
    high: Mapped[float] = mapped_column(comment="weight, not included")
    labels: Mapped[int] = mapped_column(doc="that are right or wrong, in the bin")
    mean_weight: Mapped[float | None] = mapped_column(doc="of the labels in the bin")
    precision: Mapped[float | None] = mapped_column(comment="share of right labels in the bin")
    recall: Mapped[float | None] = mapped_column(comment="right labels of the bin per object")


class EvaluationObject(Box, Base):
    """What became of an object or a detection of a val frame under KITTI's rules.

    An object is found (tp), missed (fn) or ignored, a detection is right (tp), false (fp) or
    ignored. People query it through the view `evaluation`.
    """

    __tablename__ = "evaluation_object"
    __table_args__ = (
        CheckConstraint("side IN ('object', 'detection')", name="side"),
        CheckConstraint("outcome IN ('tp', 'fp', 'fn', 'ignored')", name="outcome"),
        Index("ix_evaluation_object_outcome", "source", "outcome"),
        {"sqlite_with_rowid": False},
    )

    source: Mapped[str] = mapped_column(
        primary_key=True, comment="whose detections: e.g. round 1, or a checkpoint's path"
    )
    frame_id: Mapped[int] = mapped_column(ForeignKey("frame.id"), primary_key=True, doc="frame.id")
    side: Mapped[str] = mapped_column(primary_key=True, comment="object | detection")
    k: Mapped[int] = mapped_column(
        primary_key=True, autoincrement=False, comment="of ground_truth or of prediction"
    )
    category: Mapped[str] = mapped_column(
        primary_key=True, comment="under evaluation; a Van is an ignored object of Car"
    )
    outcome: Mapped[str] = mapped_column(comment="tp | fp | fn | ignored")
    matched_k: Mapped[int | None] = mapped_column(comment="of the other side")
    iou: Mapped[float] = mapped_column(
        comment="with the match, else the greatest with any that took part"
    )
    score: Mapped[float | None] = mapped_column(
        comment="of the detection, for objects of the matched one"
    )
    overlap: Mapped[str] = mapped_column(comment="what iou is: image | bev | 3d")
    difficulty: Mapped[str] = mapped_column(comment="objects beyond it are ignored")


class EvaluationAp(Base):
    """KITTI average precision of the detections of val frames."""

    __tablename__ = "evaluation_ap"
    __table_args__ = ({"sqlite_with_rowid": False},)

    source: Mapped[str] = mapped_column(
        primary_key=True, comment="whose detections: e.g. round 1, or a checkpoint's path"
    )
    category: Mapped[str] = mapped_column(primary_key=True, doc="under evaluation")
    figure: Mapped[str] = mapped_column(primary_key=True, comment="image | aos | bev | 3d")
    difficulty: Mapped[str] = mapped_column(primary_key=True, comment="easy | moderate | hard")
    objects: Mapped[int] = mapped_column(comment="that count")
    ap_r40: Mapped[float | None] = mapped_column(
        comment="percent", doc="at 40 recall positions", info={"unit": "%"}
    )
    ap_r11: Mapped[float | None] = mapped_column(
        comment="percent", doc="at 11 recall positions", info={"unit": "%"}
    )


class LabelFile(Base):
    """An exported label file as it was written; the firewall notices what changed since."""

    __tablename__ = "label_file"
    __table_args__ = ({"sqlite_with_rowid": False},)

    path: Mapped[str] = mapped_column(primary_key=True, comment="relative to the workspace")
    round: Mapped[int] = mapped_column(comment="0 = ground truth of X_l alone")
    policy: Mapped[str] = mapped_column(doc="whose weights it holds; '' for ground truth alone")
    sha256: Mapped[str] = mapped_column(comment="of the file")


class ViewDefinition(Base):
    """The views as they were made last; those with another definition are made anew."""

    __tablename__ = "view_definition"
    __table_args__ = ({"sqlite_with_rowid": False},)

    name: Mapped[str] = mapped_column(primary_key=True, comment="of the view")
    sha256: Mapped[str] = mapped_column(comment="of its definition")


class Task(Base):
    """What was done: one row per frame of a frame stage, one without frame per round stage."""

    __tablename__ = "task"
    __table_args__ = (
        CheckConstraint("state IN ('done', 'empty', 'failed')", name="state"),
        CheckConstraint("(state = 'failed') = (error IS NOT NULL)", name="error_iff_failed"),
        Index(
            "uq_task_frame",
            "round",
            "stage",
            "frame_id",
            unique=True,
            sqlite_where=text("frame_id IS NOT NULL"),
        ),
        Index(
            "uq_task_round",
            "round",
            "stage",
            "variant",
            unique=True,
            sqlite_where=text("frame_id IS NULL"),
        ),
    )

    id: Mapped[int] = mapped_column(primary_key=True, doc="key of the row")
    round: Mapped[int] = mapped_column(doc="round.number; 0 before the first")
    stage: Mapped[str] = mapped_column(doc="name of the stage")
    variant: Mapped[str] = mapped_column(comment="policy or format of a round stage, else ''")
    frame_id: Mapped[int | None] = mapped_column(
        ForeignKey("frame.id"), doc="frame.id; null for a stage of the whole round"
    )
    fingerprint: Mapped[str] = mapped_column(comment="of all that the result depends on")
    state: Mapped[str] = mapped_column(comment="done | empty | failed")
    error: Mapped[str | None] = mapped_column(doc="message; null unless failed")
    seconds: Mapped[float] = mapped_column(doc="time that the work took", info={"unit": "s"})
