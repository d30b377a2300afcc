"""The tables of curate, in pipeline order.

Boxes are x, y, z of the centre, length, width, height in metres and yaw in radians in the LiDAR
frame. All evidence of label k of a frame has the key of its prediction, (round, frame_id, k). The
tables therefore join by the same three columns, and deleting a prediction deletes its evidence.
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

# `comment` is stored in the database by the migrations. `doc` is not stored, and replaces `comment`
# in the descriptions that `pipelines.queries.schema` generates. `info["unit"]` is the unit.
Key = Annotated[int, mapped_column(primary_key=True, autoincrement=False)]
Metres = Annotated[float, mapped_column(comment="metres, LiDAR frame", info={"unit": "m"})]
Radians = Annotated[float, mapped_column(comment="radians, (-pi, pi]", info={"unit": "rad"})]
Pixels = Annotated[float, mapped_column(comment="pixels", info={"unit": "px"})]
Share = Annotated[float, mapped_column(comment="0 to 1", info={"unit": "1"})]
Bound = Annotated[
    float | None, mapped_column(comment="bound of its interval", doc="bound of the 95 % interval")
]


class Base(DeclarativeBase):
    """The base class of all models."""

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
    """The seven columns of a box."""

    x: Mapped[Metres] = mapped_column(doc="box centre, forward of the LiDAR")
    y: Mapped[Metres] = mapped_column(doc="box centre, to the left of the LiDAR")
    z: Mapped[Metres] = mapped_column(doc="box centre, above the LiDAR")
    length: Mapped[Metres] = mapped_column(doc="along the heading")
    width: Mapped[Metres] = mapped_column(doc="across the heading")
    height: Mapped[Metres] = mapped_column(doc="upward")
    yaw: Mapped[Radians] = mapped_column(doc="counter-clockwise from x, in (-pi, pi]")


def _evidence(*more: Any) -> tuple[Any, ...]:
    """Return the arguments of a table with rows that are deleted with their prediction."""
    key = ForeignKeyConstraint(
        ["round", "frame_id", "k"],
        ["prediction.round", "prediction.frame_id", "prediction.k"],
        ondelete="CASCADE",
    )
    return (key, *more, {"sqlite_with_rowid": False})


class Frame(Base):
    """A LiDAR-camera frame and its split."""

    __tablename__ = "frame"
    __table_args__ = (
        UniqueConstraint("dataset", "frame"),
        UniqueConstraint("id", "split"),
        Index("ix_frame_frame", "frame"),
        CheckConstraint("split IN ('labeled', 'unlabeled', 'val', 'calibration')", name="split"),
        CheckConstraint(
            "split <> 'unlabeled' OR label_path IS NULL", name="unlabeled_has_no_label"
        ),
    )

    id: Mapped[int] = mapped_column(primary_key=True, doc="number of the frame in this database")
    dataset: Mapped[str] = mapped_column(doc="kind of the data set, as in curate.toml")
    frame: Mapped[str] = mapped_column(comment="frame id within the data set")
    split: Mapped[str] = mapped_column(comment="labeled | unlabeled | val | calibration")
    points_path: Mapped[str] = mapped_column(comment="relative to the data set's root")
    image_path: Mapped[str | None] = mapped_column(
        sort_order=1,
        comment="of the first camera, relative to the data set's root; null = no images",
    )
    calibration_path: Mapped[str] = mapped_column(comment="relative to the data set's root")
    label_path: Mapped[str | None] = mapped_column(
        comment="relative to the data set's root; never for unlabeled frames"
    )


class SplitList(Base):
    """The split lists that `curate init` found and chose; the leakage firewall checks them."""

    __tablename__ = "split_list"
    __table_args__ = ({"sqlite_with_rowid": False},)

    source: Mapped[str] = mapped_column(
        primary_key=True, comment="chosen | dataset (its own) | file (given to init)"
    )
    name: Mapped[str] = mapped_column(
        primary_key=True,
        comment="labeled | unlabeled | val, or of the data set's list",
        doc="labeled | unlabeled | val | calibration, or of the data set's list",
    )
    path: Mapped[str | None] = mapped_column(comment="of the file", doc="path of the file")
    frames: Mapped[int] = mapped_column(comment="how many", doc="number of frames")
    sha256: Mapped[str] = mapped_column(comment="of names", doc="hash of `names`")
    names: Mapped[str] = mapped_column(comment="the sorted names, one per line")


class GroundTruth(Base):
    """The annotated objects of labeled and val frames, and of those set aside for calibration.

    The foreign key includes the frame's split, so the database rejects a row of an unlabeled frame.
    """

    __tablename__ = "ground_truth"
    __table_args__ = (
        ForeignKeyConstraint(["frame_id", "split"], ["frame.id", "frame.split"]),
        CheckConstraint("split IN ('labeled', 'val', 'calibration')", name="never_unlabeled"),
        {"sqlite_with_rowid": False},
    )

    frame_id: Mapped[Key] = mapped_column(doc="frame.id")
    k: Mapped[Key] = mapped_column(doc="number of the object within its frame")
    split: Mapped[str] = mapped_column(doc="labeled | val | calibration")
    category: Mapped[str] = mapped_column(doc="category of the object")
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
    """The checkpoint of a detector, trained by a round or supplied by the user."""

    __tablename__ = "checkpoint"
    __table_args__ = (UniqueConstraint("round", "policy"),)

    id: Mapped[int] = mapped_column(primary_key=True, doc="number of the row")
    round: Mapped[int] = mapped_column(
        comment="the round that made it; 0 before the first",
        doc="number of the round that trained it; 0 = before the first",
    )
    policy: Mapped[str] = mapped_column(
        comment="whose weights it learned from; '' for round 0",
        doc="policy that weighted the labels it was trained on; '' for round 0",
    )
    detector: Mapped[str] = mapped_column(doc="as in curate.toml")
    path: Mapped[str] = mapped_column(comment="relative to the workspace, or absolute")
    sha256: Mapped[str] = mapped_column(doc="hash of the file")
    created_at: Mapped[datetime] = mapped_column(DateTime(timezone=True), doc="time in UTC")


class TrainingStatistics(Base):
    """Training curves: loss terms, learning rate and gradient norm of every few steps."""

    __tablename__ = "training_statistics"
    __table_args__ = ({"sqlite_with_rowid": False},)

    round: Mapped[int] = mapped_column(
        primary_key=True,
        autoincrement=False,
        comment="as of the checkpoint",
        doc="round of the checkpoint",
    )
    policy: Mapped[str] = mapped_column(
        primary_key=True, comment="as of the checkpoint", doc="policy of the checkpoint"
    )
    step: Mapped[int] = mapped_column(
        primary_key=True,
        autoincrement=False,
        comment="of the optimiser, from 1",
        doc="optimiser step, from 1",
    )
    name: Mapped[str] = mapped_column(
        primary_key=True, comment="loss, a term of it, learning_rate or gradient_norm"
    )
    value: Mapped[float | None] = mapped_column(
        comment="of this step alone; null = not finite",
        doc="value at this step, not averaged; null = not finite",
    )


class Round(Base):
    """One round e of E: predictions of the teacher, their evidence and weights, and the student."""

    __tablename__ = "round"

    number: Mapped[Key] = mapped_column(doc="e, from 1")
    rounds: Mapped[int] = mapped_column(comment="E: e/E is the age of Eq. 4")
    teacher_id: Mapped[int | None] = mapped_column(
        ForeignKey("checkpoint.id"), doc="checkpoint.id of the detector that predicts"
    )
    config: Mapped[str] = mapped_column(comment="the whole configuration, JSON")
    code_version: Mapped[str] = mapped_column(doc="version of curate")
    seed: Mapped[int] = mapped_column(doc="seed of all random draws of the round")


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
    k: Mapped[Key] = mapped_column(doc="number of the label within its frame, by descending score")
    category: Mapped[str] = mapped_column(doc="category of the object")
    score: Mapped[Share] = mapped_column(doc="detector score s, 0 to 1")
    iou: Mapped[float | None] = mapped_column(
        sort_order=1,
        comment="the detector's estimate of its 3D IoU with the object; null = it makes none",
        doc="the detector's estimate of the box's 3D IoU with the object; null = no estimate",
    )


class FusedBox(Box, Base):
    """The box of a label with `repredict.fuse`: mean of the prediction and its repredictions.

    Without fusion the table is empty, and the box of a label is that of its prediction.
    """

    __tablename__ = "fused_box"
    __table_args__ = _evidence()

    round: Mapped[Key] = mapped_column(doc="prediction.round")
    frame_id: Mapped[Key] = mapped_column(doc="prediction.frame_id")
    k: Mapped[Key] = mapped_column(doc="prediction.k")
    boxes: Mapped[int] = mapped_column(
        sort_order=1,
        comment="in the mean; 1 = the prediction alone",
        doc="number of boxes in the mean; 1 = the prediction alone, because no view matched it",
    )


class RepredictionView(Base):
    """The similarity transform A of one augmented view of a frame."""

    __tablename__ = "reprediction_view"
    __table_args__ = ({"sqlite_with_rowid": False},)

    round: Mapped[int] = mapped_column(
        ForeignKey("round.number"), primary_key=True, doc="round.number"
    )
    frame_id: Mapped[int] = mapped_column(ForeignKey("frame.id"), primary_key=True, doc="frame.id")
    view: Mapped[Key] = mapped_column(doc="number of the view, from 0")
    flip_y: Mapped[int] = mapped_column(
        comment="1 if y was mirrored, first", doc="applied first: 1 if y is mirrored"
    )
    rotation_rad: Mapped[float] = mapped_column(
        comment="about z, radians, second",
        doc="applied second: rotation about z",
        info={"unit": "rad"},
    )
    scale: Mapped[float] = mapped_column(
        comment="of all coordinates, third", doc="applied third: scale of all coordinates"
    )


class Reprediction(Box, Base):
    """One box of A^-1 f(A(x); w), and the prediction that it is matched with."""

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
    category: Mapped[str] = mapped_column(doc="category of the object")
    score: Mapped[Share] = mapped_column(doc="detector score s', 0 to 1")
    matched_k: Mapped[int | None] = mapped_column(comment="prediction.k; null = no match")
    iou: Mapped[float | None] = mapped_column(comment="BEV IoU of the match")
    score_loss: Mapped[float | None] = mapped_column(
        comment="-ln of this score", doc="-ln s'; null = no match"
    )
    box_loss: Mapped[float | None] = mapped_column(
        comment="sum of smooth L1, beta 1/9",
        doc="sum of smooth L1 (beta 1/9) over the box residual; null = no match",
    )


class Consistency(Base):
    """The consistency loss L of a prediction: the mean over the views with a match."""

    __tablename__ = "consistency"
    __table_args__ = _evidence()

    round: Mapped[Key] = mapped_column(doc="prediction.round")
    frame_id: Mapped[Key] = mapped_column(doc="prediction.frame_id")
    k: Mapped[Key] = mapped_column(doc="prediction.k")
    loss: Mapped[float | None] = mapped_column(comment="L; null = no match, no evidence")
    views: Mapped[int] = mapped_column(doc="number of augmented views of the frame")
    matched_views: Mapped[int] = mapped_column(doc="number of views with a matched reprediction")


class PointPrior(Base):
    """Eq. 8: LiDAR points inside the box, compared with those inside labeled boxes."""

    __tablename__ = "point_prior"
    __table_args__ = _evidence()

    round: Mapped[Key] = mapped_column(doc="prediction.round")
    frame_id: Mapped[Key] = mapped_column(doc="prediction.frame_id")
    k: Mapped[Key] = mapped_column(doc="prediction.k")
    points: Mapped[int] = mapped_column(comment="m", doc="LiDAR points in the box, m")
    points_threshold: Mapped[float] = mapped_column(comment="m_th of the category")
    rho_diff: Mapped[Share] = mapped_column(doc="trust in [0, 1], Eq. 8")


class SemanticPrior(Base):
    """Eq. 9: pixels of the category's classes inside the projected box."""

    __tablename__ = "semantic_prior"
    __table_args__ = _evidence()

    round: Mapped[Key] = mapped_column(doc="prediction.round")
    frame_id: Mapped[Key] = mapped_column(doc="prediction.frame_id")
    k: Mapped[Key] = mapped_column(doc="prediction.k")
    mask_pixels: Mapped[int] = mapped_column(
        comment="S", doc="pixels of the category's classes in the box's rectangle, S"
    )
    box_pixels: Mapped[int] = mapped_column(
        comment="A; 0 = outside the image",
        doc="pixels of the projected box's rectangle, A; 0 = outside the image",
    )
    rho_anno: Mapped[Share] = mapped_column(doc="trust in [0, 1], Eq. 9")
    camera: Mapped[str | None] = mapped_column(
        sort_order=1,
        comment="of several, the one that shows most of the box; null = one camera, or none shows "
        "it",
    )
    share_reference: Mapped[float | None] = mapped_column(
        sort_order=1,
        comment="by which S/A was divided; null = it was not",
        doc="upper quartile of S/A over labeled boxes, by which S/A was divided; null = it was not",
    )


class SemanticReference(Base):
    """Upper quartile of S/A over the labeled boxes of a category, for `semantic.reference`.

    It is not used below 0.15.
    """

    __tablename__ = "semantic_reference"
    __table_args__ = ({"sqlite_with_rowid": False},)

    category: Mapped[str] = mapped_column(primary_key=True, doc="category of the boxes")
    boxes: Mapped[int] = mapped_column(
        comment="labeled boxes that an image shows", doc="number of labeled boxes in an image"
    )
    upper_quartile: Mapped[float | None] = mapped_column(
        comment="of S/A; null = no such box", doc="upper quartile of their S/A; null = no such box"
    )
    fingerprint: Mapped[str] = mapped_column(
        comment="of all that it depends on",
        doc="hash of everything that it depends on: labeled frames, segmenter, categories",
    )


class EvidenceSource(Base):
    """The declaration of an evidence source with a table `prior_NAME`."""

    __tablename__ = "evidence_source"
    __table_args__ = ({"sqlite_with_rowid": False},)

    name: Mapped[str] = mapped_column(
        primary_key=True,
        comment="its table is prior_NAME",
        doc="name of the source; its table is prior_NAME",
    )
    source: Mapped[str] = mapped_column(
        comment="as run.priors names it", doc="name of the source in run.priors"
    )
    columns: Mapped[str] = mapped_column(
        comment="JSON: name, kind, unit, meaning and optional of each",
        doc="JSON: name, kind, unit, meaning and optional of each column",
    )
    rho_column: Mapped[str | None] = mapped_column(
        comment="the column with its trust in [0, 1]; null = not a prior",
        doc="name of the column with the trust in [0, 1]; null = the source is not a prior",
    )


class Calibration(Base):
    """The fit of a round, which turns the evidence of a label into a probability of being correct.

    It is made from the labels of frames with ground truth that the teacher has not been trained on.
    `calibration_label` has the labels that no fit has used, for the bound `max_wrong`.
    """

    __tablename__ = "calibration"
    __table_args__ = ({"sqlite_with_rowid": False},)

    round: Mapped[int] = mapped_column(
        ForeignKey("round.number"), primary_key=True, doc="round.number"
    )
    source: Mapped[str] = mapped_column(
        comment="calibration | folds",
        doc="where the labels are from: calibration (frames set aside) | folds (of X_l)",
    )
    folds: Mapped[int] = mapped_column(
        comment="0 = frames set aside", doc="number of folds; 0 = frames set aside"
    )
    overlap: Mapped[str] = mapped_column(
        comment="bev | 3d", doc="overlap that makes a label correct: bev | 3d"
    )
    thresholds: Mapped[str] = mapped_column(
        comment="kitti | relaxed", doc="IoU thresholds of that overlap: kitti | relaxed"
    )
    teacher: Mapped[str] = mapped_column(
        comment="hash of the checkpoint, '' for a command without one",
        doc="hash of the teacher's checkpoint; '' for a command without one",
    )
    frames: Mapped[int] = mapped_column(
        comment="with ground truth", doc="frames of the fit, with or without labels"
    )
    labels: Mapped[int] = mapped_column(
        comment="that are right or wrong", doc="labels of the fit, without the neutral ones"
    )
    neutral: Mapped[int] = mapped_column(
        comment="further labels that are neither",
        doc="labels that are neither correct nor wrong, and are not used",
    )
    right_labels: Mapped[int] = mapped_column(doc="correct labels of the fit")
    auroc: Mapped[float | None] = mapped_column(
        comment="out of sample", doc="AUROC of the probability in frames that the fit did not use"
    )
    calibration_error: Mapped[float | None] = mapped_column(
        comment="out of sample",
        doc="calibration error of the probability in frames that the fit did not use",
    )
    fit: Mapped[str | None] = mapped_column(
        comment="JSON; null = too few labels",
        doc="JSON: evidence, scaling and coefficients; null = too few labels",
    )
    fallback: Mapped[str | None] = mapped_column(
        comment="why there is no fit; null = there is one",
        doc="why there is no fit, so that pspsl weights the labels; null = there is one",
    )
    unit: Mapped[str] = mapped_column(
        comment="frame | sequence",
        doc="what is exchangeable with the unlabeled frames: frame | sequence",
    )
    held_out_frames: Mapped[int] = mapped_column(
        comment="for max_wrong; 0 = none",
        doc="frames of calibration_label, with or without labels; 0 = max_wrong is not set",
    )


class CalibrationLabel(Base):
    """A label of a frame that neither the teacher nor the fit has used, for the bound `max_wrong`.

    The teacher of the round has predicted it.
    """

    __tablename__ = "calibration_label"
    __table_args__ = _evidence()

    round: Mapped[Key] = mapped_column(doc="prediction.round")
    frame_id: Mapped[Key] = mapped_column(doc="prediction.frame_id")
    k: Mapped[Key] = mapped_column(doc="prediction.k")
    probability: Mapped[Share] = mapped_column(doc="probability that it is correct, by the fit")
    correct: Mapped[int | None] = mapped_column(
        comment="1 = right, 0 = wrong, null = neither",
        doc="1 = correct, 0 = wrong, null = neither, such as a label in a DontCare region",
    )
    unit: Mapped[str] = mapped_column(
        comment="the sequence, or the frame",
        doc="sequence of the frame; the frame itself where there are no sequences",
    )


class Weight(Base):
    """The reliability weight v that one policy gives a label; a label has one row per policy.

    The policy defines what v = 0 means: background, or ignored if the policy has a band of doubt.
    A label that a policy drops has no row for that policy. The weights of each policy have an index
    of their own, see `db.weight_index`.
    """

    __tablename__ = "weight"
    __table_args__ = _evidence()

    round: Mapped[Key] = mapped_column(doc="prediction.round")
    frame_id: Mapped[Key] = mapped_column(doc="prediction.frame_id")
    k: Mapped[Key] = mapped_column(doc="prediction.k")
    policy: Mapped[str] = mapped_column(primary_key=True, doc="name of the policy")
    lambda_u: Mapped[float | None] = mapped_column(
        comment="Eq. 4; null where unused", doc="Eq. 4; null = not used by the policy"
    )
    rho_det: Mapped[float | None] = mapped_column(comment="product of the priors")
    v: Mapped[Share] = mapped_column(doc="weight in [0, 1]; the policy defines what 0 means")
    probability: Mapped[float | None] = mapped_column(
        comment="that the label is right; null = not estimated",
        doc="probability that the label is correct; null = the policy does not estimate it",
    )


class LabelCount(Base):
    """The number of labels that a policy has weighted in a round, per category.

    `solve` writes it together with `weight`, because counting millions of labels takes seconds.
    """

    __tablename__ = "label_count"
    __table_args__ = ({"sqlite_with_rowid": False},)

    round: Mapped[int] = mapped_column(
        ForeignKey("round.number"), primary_key=True, doc="round.number"
    )
    policy: Mapped[str] = mapped_column(primary_key=True, doc="policy that weighted the labels")
    category: Mapped[str] = mapped_column(primary_key=True, doc="category of the labels")
    labels: Mapped[int] = mapped_column(
        comment="that the policy did not drop", doc="labels that the policy did not drop"
    )
    kept: Mapped[int] = mapped_column(
        comment="with a weight above 0", doc="labels with a weight above 0"
    )
    trusted: Mapped[int] = mapped_column(
        comment="with a weight above 0.5", doc="labels with a weight above 0.5"
    )
    weight: Mapped[float] = mapped_column(comment="sum of the weights")


class Review(Base):
    """An export of labels for an editor, and the import of its results."""

    __tablename__ = "review"

    id: Mapped[str] = mapped_column(primary_key=True, comment="hash of its manifest")
    round: Mapped[int] = mapped_column(comment="whose labels", doc="round of the labels")
    policy: Mapped[str] = mapped_column(
        comment="whose weights chose them", doc="policy with the weights that selected the labels"
    )
    editor: Mapped[str] = mapped_column(comment="kitti | labelcloud | cvat")
    frames: Mapped[int] = mapped_column(doc="number of exported frames")
    boxes: Mapped[int] = mapped_column(
        comment="in all, those for context included",
        doc="number of exported boxes, including those shown for context",
    )
    asked: Mapped[int] = mapped_column(
        comment="of the boxes", doc="number of boxes that need a decision"
    )
    exported_at: Mapped[str] = mapped_column(comment="ISO 8601, UTC")
    imported_at: Mapped[str | None] = mapped_column(comment="ISO 8601, UTC; null = not yet")


class HumanLabel(Box, Base):
    """A person's decision about an object of an unlabeled frame, valid in later rounds too.

    The foreign key includes the frame's split, so the database rejects a row of a labeled or val
    frame. The box is the object's, or the rejected box.
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
        comment="number of the box in the review; null = added",
        doc="k of the label in the reviewed round, in imports of curate 0.1 its place from 1; "
        "null = added",
    )
    decision: Mapped[str] = mapped_column(comment="accepted | rejected | moved | added")
    category: Mapped[str] = mapped_column(doc="category of the object")
    from_round: Mapped[int] = mapped_column(
        comment="it counts in this round and later", doc="first round in which it is valid"
    )
    seen_x: Mapped[float | None] = mapped_column(
        sort_order=1,
        comment="metres, LiDAR frame: the box as it was shown; null = none",
        doc="x of the box that the editor showed; null = added",
        info={"unit": "m"},
    )
    seen_y: Mapped[Metres | None] = mapped_column(sort_order=1, doc="y of the shown box")
    seen_z: Mapped[Metres | None] = mapped_column(sort_order=1, doc="z of the shown box")
    seen_length: Mapped[Metres | None] = mapped_column(sort_order=1, doc="length of the shown box")
    seen_width: Mapped[Metres | None] = mapped_column(sort_order=1, doc="width of the shown box")
    seen_height: Mapped[Metres | None] = mapped_column(sort_order=1, doc="height of the shown box")
    seen_yaw: Mapped[Radians | None] = mapped_column(sort_order=1, doc="yaw of the shown box")
    reviewer: Mapped[str] = mapped_column(
        sort_order=2, comment="who decided", doc="name of the person who decided"
    )
    decided_at: Mapped[str] = mapped_column(sort_order=2, comment="ISO 8601, UTC")


class HumanMatch(Base):
    """A prediction that matches a human label, so that no object is labeled twice.

    If the label is `rejected`, the prediction has weight 0 under every policy. Otherwise the box of
    the human label replaces the prediction in `weighted_labels`.
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
    iou: Mapped[float] = mapped_column(
        comment="BEV IoU with its box, or the one seen",
        doc="BEV IoU of the prediction with the human label's box, or with the shown box",
    )
    leads: Mapped[int] = mapped_column(
        comment="1 if the human label stands in weighted_labels under this k",
        doc="1 if the human label has this k in weighted_labels",
    )


class Proposal(Box, Base):
    """A candidate for a missed object: an image mask without a label, boxed by its LiDAR points.

    It is for review. It has no weight and is in no export and no view of labels.
    """

    __tablename__ = "proposal"
    __table_args__ = ({"sqlite_with_rowid": False},)

    round: Mapped[Key] = mapped_column(
        comment="whose labels lack it; 0 = ground truth",
        doc="round with the labels that lack it; 0 = ground truth lacks it",
    )
    frame_id: Mapped[int] = mapped_column(ForeignKey("frame.id"), primary_key=True, doc="frame.id")
    n: Mapped[Key] = mapped_column(doc="number of the proposal within its frame")
    category: Mapped[str] = mapped_column(doc="category of the mask")
    points: Mapped[int] = mapped_column(
        sort_order=1, comment="of the object", doc="LiDAR points of the object"
    )
    pixels: Mapped[int] = mapped_column(
        sort_order=1,
        comment="of its mask that no label covers",
        doc="pixels of its mask that no label covers",
        info={"unit": "px"},
    )
    camera: Mapped[str | None] = mapped_column(
        sort_order=1, comment="of several; null = one", doc="its camera; null = only one camera"
    )
    provenance: Mapped[str] = mapped_column(sort_order=1, doc="always proposal")


class _Audited:
    """The key columns of the audit tables."""

    round: Mapped[int] = mapped_column(
        primary_key=True, sort_order=-1, comment="of the teacher", doc="round of the teacher"
    )
    frames: Mapped[str] = mapped_column(
        primary_key=True,
        sort_order=-1,
        comment="which: val, labeled, or e.g. 5 folds",
        doc="frames of the audit: val, labeled, or e.g. 5 folds",
    )
    overlap: Mapped[str] = mapped_column(primary_key=True, sort_order=-1, comment="bev | 3d")
    policy: Mapped[str] = mapped_column(
        primary_key=True,
        sort_order=-1,
        comment="or score, rho_det, consistency: evidence by itself",
        doc="policy, or score, rho_det, consistency, probability: evidence used as the weight",
    )
    category: Mapped[str] = mapped_column(
        primary_key=True, sort_order=-1, comment="or 'all'", doc="category, or 'all'"
    )


class _Figures:
    """The figures of an audit; each is null if it is undefined."""

    labels: Mapped[int] = mapped_column(
        comment="that are right or wrong", doc="number of labels, without the neutral ones"
    )
    neutral: Mapped[int] = mapped_column(
        comment="further labels that are neither",
        doc="number of labels that are neither correct nor wrong",
    )
    right_labels: Mapped[int] = mapped_column(
        comment="of the labels", doc="number of correct labels"
    )
    objects: Mapped[int | None] = mapped_column(
        comment="to be found; null = unknown", doc="number of ground-truth objects; null = unknown"
    )
    share_right: Mapped[float | None] = mapped_column(doc="right_labels / labels")
    share_right_low: Mapped[Bound]
    share_right_high: Mapped[Bound]
    auroc: Mapped[float | None] = mapped_column(
        comment="chance that a right label weighs more than a wrong one",
        doc="probability that a correct label has a greater weight than a wrong one",
    )
    auroc_low: Mapped[Bound]
    auroc_high: Mapped[Bound]
    average_precision: Mapped[float | None] = mapped_column(
        comment="of the labels ranked by weight",
        doc="average precision of the labels ranked by weight",
    )
    average_precision_low: Mapped[Bound]
    average_precision_high: Mapped[Bound]
    weighted_precision: Mapped[float | None] = mapped_column(
        comment="share of the weight that lies on right labels",
        doc="share of the total weight that is on correct labels",
    )
    weighted_precision_low: Mapped[Bound]
    weighted_precision_high: Mapped[Bound]
    weighted_recall: Mapped[float | None] = mapped_column(
        comment="weight on right labels per object",
        doc="total weight of correct labels / objects",
    )
    weighted_recall_low: Mapped[Bound]
    weighted_recall_high: Mapped[Bound]
    calibration_error: Mapped[float | None] = mapped_column(
        comment="expected distance of weight and share of right labels",
        doc="expected difference between the weight and the share of correct labels",
    )
    calibration_error_low: Mapped[Bound]
    calibration_error_high: Mapped[Bound]
    calibration_error_by_chance: Mapped[float | None] = mapped_column(
        sort_order=1, doc="mean calibration error of perfectly calibrated weights on these labels"
    )
    calibration_error_limit: Mapped[float | None] = mapped_column(
        sort_order=1,
        doc="calibration error that 95 % of perfectly calibrated weights do not exceed",
    )
    reference: Mapped[str | None] = mapped_column(
        sort_order=1,
        doc="policy with the weighted recall of equal_recall_precision; null = no weight is given",
    )
    equal_recall_power: Mapped[float | None] = mapped_column(
        sort_order=1,
        doc="power of the weights that gives the weighted recall of the reference; null = none, or "
        "infinite",
    )
    equal_recall_precision: Mapped[float | None] = mapped_column(
        sort_order=1, doc="weighted precision of the weights to that power"
    )
    equal_recall_precision_low: Mapped[Bound] = mapped_column(sort_order=1)
    equal_recall_precision_high: Mapped[Bound] = mapped_column(sort_order=1)


class Audit(_Audited, _Figures, Base):
    """How well a policy's weights separate correct from wrong labels on frames with ground truth.

    The frames are processed as if they were unlabeled. Bounds are those of 95 % confidence
    intervals, resampled over frames, or over sequences if there are any.
    """

    __tablename__ = "audit"
    __table_args__ = ({"sqlite_with_rowid": False},)


class AuditSlice(_Audited, _Figures, Base):
    """The figures of an audit for labels in a range of distance or of LiDAR points."""

    __tablename__ = "audit_slice"
    __table_args__ = ({"sqlite_with_rowid": False},)

    kind: Mapped[str] = mapped_column(primary_key=True, comment="distance | points")
    low: Mapped[float] = mapped_column(
        primary_key=True,
        comment="metres or points, included",
        doc="lower bound of the range in metres or points, inclusive",
    )
    high: Mapped[float | None] = mapped_column(
        comment="metres or points, not included; null = open",
        doc="upper bound in metres or points, exclusive; null = unbounded",
    )


class AuditDifference(_Audited, Base):
    """The difference between a figure of two policies in an audit: that of `policy` - of `other`.

    Bounds are those of a 95 % confidence interval over the same draws of frames, or of sequences.
    """

    __tablename__ = "audit_difference"
    __table_args__ = ({"sqlite_with_rowid": False},)

    other: Mapped[str] = mapped_column(primary_key=True, doc="the policy that is subtracted")
    figure: Mapped[str] = mapped_column(
        primary_key=True,
        doc="column of audit: auroc | average_precision | equal_recall_precision | "
        "calibration_error",
    )
    difference: Mapped[float] = mapped_column(doc="figure of policy - figure of other")
    low: Mapped[Bound]
    high: Mapped[Bound]
    real: Mapped[int] = mapped_column(doc="1 = the interval excludes 0; 0 = it may be chance")


class AuditBin(_Audited, Base):
    """The labels of an audit with a weight in a bin; the last bin includes its upper edge."""

    __tablename__ = "audit_bin"
    __table_args__ = ({"sqlite_with_rowid": False},)

    low: Mapped[float] = mapped_column(
        primary_key=True, comment="weight, included", doc="lower edge of the bin, inclusive"
    )
    high: Mapped[float] = mapped_column(
        comment="weight, not included", doc="upper edge of the bin, exclusive"
    )
    labels: Mapped[int] = mapped_column(doc="number of labels in the bin, without the neutral ones")
    mean_weight: Mapped[float | None] = mapped_column(doc="mean weight of the labels in the bin")
    precision: Mapped[float | None] = mapped_column(
        comment="share of right labels in the bin", doc="share of correct labels in the bin"
    )
    recall: Mapped[float | None] = mapped_column(
        comment="right labels of the bin per object", doc="correct labels in the bin / objects"
    )


class EvaluationObject(Box, Base):
    """The outcome of an object or a detection of a val frame under KITTI's rules.

    An object is found (tp), missed (fn) or ignored. A detection is correct (tp), false (fp) or
    ignored. The view `evaluation` adds the frame's name and the object's annotation.
    """

    __tablename__ = "evaluation_object"
    __table_args__ = (
        CheckConstraint("side IN ('object', 'detection')", name="side"),
        CheckConstraint("outcome IN ('tp', 'fp', 'fn', 'ignored')", name="outcome"),
        Index("ix_evaluation_object_outcome", "source", "outcome"),
        {"sqlite_with_rowid": False},
    )

    source: Mapped[str] = mapped_column(
        primary_key=True,
        comment="whose detections: e.g. round 1, or a checkpoint's path",
        doc="source of the detections: e.g. round 1, or a checkpoint's path",
    )
    frame_id: Mapped[int] = mapped_column(ForeignKey("frame.id"), primary_key=True, doc="frame.id")
    side: Mapped[str] = mapped_column(primary_key=True, comment="object | detection")
    k: Mapped[int] = mapped_column(
        primary_key=True,
        autoincrement=False,
        comment="of ground_truth or of prediction",
        doc="ground_truth.k of an object, number of a detection",
    )
    category: Mapped[str] = mapped_column(
        primary_key=True,
        comment="under evaluation; a Van is an ignored object of Car",
        doc="evaluated category; e.g. a Van is an ignored object of Car",
    )
    outcome: Mapped[str] = mapped_column(comment="tp | fp | fn | ignored")
    matched_k: Mapped[int | None] = mapped_column(
        comment="of the other side", doc="k of the match on the other side; null = no match"
    )
    iou: Mapped[float] = mapped_column(
        comment="with the match, else the greatest with any that took part",
        doc="IoU with the match; without a match, the greatest IoU with any candidate",
    )
    score: Mapped[float | None] = mapped_column(
        comment="of the detection, for objects of the matched one",
        doc="score of the detection; for an object, that of its match",
    )
    overlap: Mapped[str] = mapped_column(
        comment="what iou is: image | bev | 3d", doc="kind of IoU: image | bev | 3d"
    )
    difficulty: Mapped[str] = mapped_column(
        comment="objects beyond it are ignored",
        doc="level with the most objects, such as hard; objects beyond it are ignored",
    )


class EvaluationAp(Base):
    """KITTI average precision of the detections of val frames; null if it cannot be computed."""

    __tablename__ = "evaluation_ap"
    __table_args__ = ({"sqlite_with_rowid": False},)

    source: Mapped[str] = mapped_column(
        primary_key=True,
        comment="whose detections: e.g. round 1, or a checkpoint's path",
        doc="source of the detections: e.g. round 1, or a checkpoint's path",
    )
    category: Mapped[str] = mapped_column(primary_key=True, doc="evaluated category")
    figure: Mapped[str] = mapped_column(primary_key=True, comment="image | aos | bev | 3d")
    difficulty: Mapped[str] = mapped_column(
        primary_key=True,
        comment="easy | moderate | hard",
        doc="easy | moderate | hard, or a level by points or distance, such as 0-30 m",
    )
    objects: Mapped[int] = mapped_column(
        comment="that count", doc="number of objects, without ignored ones"
    )
    ap_r40: Mapped[float | None] = mapped_column(
        comment="percent", doc="at 40 recall positions", info={"unit": "%"}
    )
    ap_r11: Mapped[float | None] = mapped_column(
        comment="percent", doc="at 11 recall positions", info={"unit": "%"}
    )


class LabelFile(Base):
    """An exported label file; the leakage firewall detects later changes by its hash."""

    __tablename__ = "label_file"
    __table_args__ = ({"sqlite_with_rowid": False},)

    path: Mapped[str] = mapped_column(primary_key=True, comment="relative to the workspace")
    round: Mapped[int] = mapped_column(comment="0 = ground truth of X_l alone")
    policy: Mapped[str] = mapped_column(
        doc="policy of the weights in the file; '' for ground truth alone"
    )
    sha256: Mapped[str] = mapped_column(comment="of the file", doc="hash of the file")


class ViewDefinition(Base):
    """The definition of each view in the database; a view with an older one is recreated."""

    __tablename__ = "view_definition"
    __table_args__ = ({"sqlite_with_rowid": False},)

    name: Mapped[str] = mapped_column(
        primary_key=True, comment="of the view", doc="name of the view"
    )
    sha256: Mapped[str] = mapped_column(comment="of its definition", doc="hash of its definition")


class Task(Base):
    """The finished work: one row per stage and frame, or per round, stage and policy."""

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

    id: Mapped[int] = mapped_column(primary_key=True, doc="number of the row")
    round: Mapped[int] = mapped_column(doc="round.number; 0 before the first")
    stage: Mapped[str] = mapped_column(doc="name of the stage")
    variant: Mapped[str] = mapped_column(
        comment="policy or format of a round stage, else ''",
        doc="policy of a round stage, sequence of a stage of sequences, else ''",
    )
    frame_id: Mapped[int | None] = mapped_column(
        ForeignKey("frame.id"), doc="frame.id; null for a stage of the whole round"
    )
    fingerprint: Mapped[str] = mapped_column(
        comment="of all that the result depends on",
        doc="hash of everything that the result depends on",
    )
    state: Mapped[str] = mapped_column(comment="done | empty | failed")
    error: Mapped[str | None] = mapped_column(doc="error message; null unless failed")
    seconds: Mapped[float] = mapped_column(doc="time that the work took", info={"unit": "s"})
