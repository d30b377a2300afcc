"""The configuration of a workspace, `curate.toml`: every setting with its meaning, unit and range.

docs/config.md, the comments in `curate.toml`, the JSON Schema and the error messages are all made
from the fields of these classes.
"""

import math
import tomllib
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from curate.category_names import check_rename
from curate.detections import CATEGORIES
from curate.detectors.precision import Precision
from curate.errors import ConfigError, one_line
from curate.evaluation.kitti_rules import overlaps_of
from curate.files.text import read_text
from curate.files.toml_text import parse_toml, toml
from curate.ranges import AtLeastOne, Count, Share
from pipelines import registry
from pipelines.workspace.config_errors import describe_errors
from pipelines.workspace.names import KnownClassSet, KnownDevice, KnownName, KnownProvider

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Scale = Annotated[float, Field(gt=0, le=100)]
Overlaps = dict[str, Annotated[float, Field(gt=0, lt=1)]]
PointCount = Annotated[float, Field(ge=1, allow_inf_nan=False)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Options = dict[str, Any]

DatasetKind = Annotated[str, KnownName(registry.DATASETS)]
DetectorName = Annotated[str, KnownName(registry.DETECTORS)]
SegmenterName = Annotated[str, KnownName(registry.SEGMENTERS, ("none", "simulated"))]
PriorName = Annotated[str, KnownName(registry.PRIORS)]
PolicyName = Annotated[str, KnownName(registry.POLICIES)]
ExporterName = Annotated[str, KnownName(registry.EXPORTERS)]
ExecutorName = Annotated[str, KnownName(registry.EXECUTORS)]
ProviderName = Annotated[str, KnownProvider()]
DEFAULT_PRIORS = ("points", "semantic")


def _unit(unit: str) -> dict[str, Any]:
    """Return the JSON Schema entry for the unit of a field; "1" for a dimensionless number."""
    return {"unit": unit}


def _each_once(names: tuple[str, ...]) -> tuple[str, ...]:
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(f"'{repeated[0]}' is listed twice")
    return names


def _rising(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[0] > limits[1]:
        raise ValueError("the lower limit must come first")
    return limits


def _final_names(rename: dict[str, str] | None) -> dict[str, str] | None:
    try:
        check_rename(rename or {})
    except ConfigError as error:  # pydantic collects ValueError
        raise ValueError(str(error)) from error
    return rename


Rename = Annotated[dict[str, str] | None, AfterValidator(_final_names)]


def _own_rename(section: Any, key: str, name: str) -> Any:
    """Move `options.rename`, as 0.1 had it for one class, to the setting of all classes."""
    if not isinstance(section, Mapping) or section.get(key) != name:
        return section
    options = section.get("options")
    if not isinstance(options, Mapping) or "rename" not in options:
        return section
    if section.get("rename") is not None:
        raise ValueError("both rename and options.rename are set; remove options.rename")
    kept = {each: value for each, value in options.items() if each != "rename"}
    return {**section, "options": kept, "rename": options["rename"]}


def _as_list(names: Any) -> Any:
    """Return a single name as a list of one."""
    return (names,) if isinstance(names, str) and names != "auto" else names


ProviderNames = Annotated[
    Annotated[tuple[ProviderName, ...], Field(min_length=1), AfterValidator(_each_once)]
    | Literal["auto"],
    BeforeValidator(_as_list),
]


def _plain_options(options: dict[str, dict[str, Any]] | None) -> dict[str, dict[str, Any]] | None:
    for provider, values in (options or {}).items():
        for key, value in values.items():
            if not isinstance(value, str | int | float):
                raise ValueError(  # noqa: TRY004 - pydantic collects ValueError
                    f"{provider}.{key} = {toml(value)}: use a string, a number, true or false"
                )
    return options


ProviderTable = Annotated[
    dict[ProviderName, Options] | None,
    AfterValidator(_plain_options),
    Field(
        description="Options of the providers by their names.",
        examples=[{"cuda": {"device_id": 1}}],
    ),
]


def _falling(numbers: tuple[int, ...]) -> tuple[int, ...]:
    if any(a <= b for a, b in pairwise(numbers)):
        raise ValueError("the largest number must come first, each only once")
    return numbers


def _strictly_rising(limits: tuple[float, ...]) -> tuple[float, ...]:
    if any(a >= b for a, b in pairwise(limits)):
        raise ValueError("the smallest distance must come first, each only once")
    return limits


class Section(BaseModel):
    """A table of settings; unknown keys are rejected."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class DatasetSection(Section):
    """Where the frames are and which categories count."""

    kind: DatasetKind = Field(default="kitti", description="Layout of the data set.")
    root: Path = Field(
        description="Folder of the data set. A relative path starts at the workspace."
    )
    categories: Annotated[tuple[str, ...], Field(min_length=1), AfterValidator(_each_once)] = Field(
        default=CATEGORIES,
        description="Categories to detect. Labels of all others are not used.",
    )
    rename: Rename = Field(
        default=None,
        description="Category for names in the label files; other names stay as they are.",
        examples=[{"car": "Car"}],
    )
    split_by: Literal["sequence", "frame"] = Field(
        default="sequence",
        description="Unit of the split: whole sequences or single frames. With 'frame', "
        "near-duplicate frames of a sequence end up in several splits.",
    )
    columns: Annotated[int, Field(ge=3, le=64)] | None = Field(
        default=None,
        description="Number of float32 columns of point files without a header (.bin, .npy). "
        "Without it, the number of the data set's format; a file that looks like another number "
        "is rejected.",
        json_schema_extra=_unit("columns"),
        examples=[5],
    )
    column_names: Annotated[tuple[str, ...], Field(min_length=3)] | None = Field(
        default=None,
        description="Names of these columns, in the order of the file. x, y and z are needed, an "
        "intensity is not. Without it, x, y, z, intensity and columns that are not read.",
        examples=[["x", "y", "z", "intensity", "ring"]],
    )
    intensity_field: str | None = Field(
        default=None,
        description="Column or field of the intensity. It is only needed where several may be it, "
        "such as intensity and reflectivity in one file.",
        examples=["reflectivity"],
    )
    intensity_scale: Positive | None = Field(
        default=None,
        description="Value of full intensity in the point files. Without it, that of the data "
        "set's format (1; nuScenes 255). Files with larger values are rejected.",
        json_schema_extra=_unit("1"),
        examples=[255.0],
    )
    follow_links: bool = Field(
        default=False, description="Whether links in the data set may lead out of its folder."
    )
    options: Options = Field(
        default={}, description="Further arguments of the data set's class; see docs/datasets.md."
    )

    @model_validator(mode="before")
    @classmethod
    def _move_rename(cls, section: Any) -> Any:
        return _own_rename(section, "kind", "nuscenes")


class DetectorSection(Section):
    """The detector that makes the predictions."""

    name: DetectorName = Field(
        default="pillars", description="Detector to use; see docs/detectors.md."
    )
    path: Path | None = Field(
        default=None,
        description="Checkpoint, model or result files of your own detector. Without it, curate "
        "trains the first teacher.",
        examples=["results/predictions.pkl"],
    )
    augmented: Path | None = Field(
        default=None,
        description="Folder of `curate augment` with the results of the copies, for recorded "
        "results. {round} and {split} stand for the number of the round and the split of the "
        "frames; a relative path starts at the workspace.",
        examples=["copies/{round}-{split}"],
    )
    unseen: Path | Literal["labeled"] | None = Field(
        default=None,
        description="Labeled frames that your own detector has not been trained on, for `curate "
        "calibrate`: a file with their ids, or 'labeled' for all of them.",
        examples=["labeled"],
    )
    device: Annotated[str, KnownDevice()] = Field(
        default="auto",
        description="Where the detector runs and trains: 'cpu', or a device of torch such as "
        "'cuda', 'cuda:1', 'mps' or 'xpu'. 'auto' uses such a device if there is one.",
    )
    providers: ProviderNames = Field(
        default="auto",
        description="Execution providers of ONNX Runtime for a detector in ONNX, the preferred one "
        "first; each must work. 'auto' takes one that fits the device; see docs/detectors.md.",
    )
    provider_options: ProviderTable = None
    precision: Precision = Field(
        default="float32",
        description="Type of numbers in which a detector in torch predicts. The shorter ones save "
        "time on a GPU and change scores in about the third digit.",
    )
    minimum_score: Share = Field(
        default=0.1,
        description="Predictions with a lower score are dropped. Keep it low: the weight decides "
        "which labels count.",
        json_schema_extra=_unit("1"),
    )
    batch_size: AtLeastOne | Literal["auto"] = Field(
        default="auto",
        description="Frames that a detector which takes batches gets at a time. 'auto': as the "
        "detector prefers on its device. It changes no prediction.",
        json_schema_extra=_unit("frames"),
    )
    workers: AtLeastOne | Literal["auto"] = Field(
        default="auto",
        description="The most workers of run.workers that run the detector at the same time. "
        "'auto': all of them, but one for a model on a GPU, and for a command, which may need the "
        "whole GPU.",
        json_schema_extra=_unit("workers"),
    )
    timeout_s: Positive = Field(
        default=3600.0,
        description="Seconds after which a command that has not finished a batch is ended.",
        json_schema_extra=_unit("s"),
    )
    camera_view: bool = Field(
        default=True,
        description="Whether the detector gets only the points that the camera sees.",
    )
    rename: Rename = Field(
        default=None,
        description="Category for names that the detector returns; other names stay as they are.",
        examples=[{"car": "Car"}],
    )
    score_meaning: str | None = Field(
        default=None,
        description="What a score of the detector estimates, for explain and audit. Without it, "
        "what the detector itself says. It changes no result.",
        examples=["the 3D IoU of the box with the object"],
    )
    options: Options = Field(
        default={}, description="Further arguments of the detector's class; see docs/detectors.md."
    )

    @model_validator(mode="before")
    @classmethod
    def _move_rename(cls, section: Any) -> Any:
        return _own_rename(section, "name", "recorded")


class SegmenterSection(Section):
    """The segmenter that computes the semantic maps for the semantic prior."""

    name: SegmenterName = Field(
        default="none",
        description="Segmenter to use. 'simulated' is the model for simulated images that curate "
        "ships; 'none' needs run.priors without 'semantic'.",
    )
    path: Path | None = Field(
        default=None,
        description="Model, folder of saved maps, or file of masks.",
        examples=["models/segmenter.onnx"],
    )
    classes: Annotated[str, KnownClassSet()] | None = Field(
        default=None,
        description="Class set that gives the segmenter's class ids their meaning; see "
        "docs/segmenters.md.",
        examples=["cityscapes"],
    )
    providers: ProviderNames = Field(
        default="auto",
        description="Execution providers of ONNX Runtime for a segmenter in ONNX, the preferred "
        "one first; each must work. 'auto' takes the best one that is installed and works; see "
        "docs/segmenters.md.",
    )
    provider_options: ProviderTable = None
    rename: Rename = Field(
        default=None,
        description="Category for names in the segmenter's table of classes; other names stay as "
        "they are.",
        examples=[{"car": "Car"}],
    )
    options: Options = Field(
        default={},
        description="Further arguments of the segmenter's class; see docs/segmenters.md.",
    )
    cache: Path | None = Field(
        default=None,
        description="Folder of the stored semantic maps. Without it, maps in the workspace. "
        "Workspaces with the same images and segmenter can share one.",
        examples=["/data/kitti-maps"],
    )
    cache_limit: NonNegative = Field(
        default=20.0,
        description="Largest size of this folder. Maps beyond it are not stored, but made again "
        "each time they are needed. 0 stores no map.",
        json_schema_extra=_unit("GiB"),
    )


class RepredictSection(Section):
    """The augmented copies A(x) of a frame, and the consistency loss between their predictions."""

    views: AtLeastOne = Field(
        default=1,
        description="Number of augmented copies of each frame. L is the mean over the copies that "
        "matched.",
        json_schema_extra=_unit("copies"),
    )
    flip_probability: Share = Field(
        default=0.5,
        description="Probability that a copy is flipped over the x axis.",
        json_schema_extra=_unit("1"),
    )
    rotation_limit_rad: Annotated[float, Field(ge=0, le=math.pi)] = Field(
        default=0.7853981633974483,
        description="A copy is rotated about z by at most this angle, in either direction.",
        json_schema_extra=_unit("rad"),
    )
    scale_range: Annotated[tuple[Scale, Scale], AfterValidator(_rising)] = Field(
        default=(0.95, 1.05),
        description="Limits of the factor by which a copy is scaled.",
        json_schema_extra=_unit("1"),
    )
    score_weight: NonNegative = Field(
        default=1.0,
        description="Weight of -ln s' in L, where s' is the score of the reprediction.",
        json_schema_extra=_unit("1"),
    )
    box_weight: NonNegative = Field(
        default=2.0,
        description="Weight of the smooth L1 loss of the box residual in L.",
        json_schema_extra=_unit("1"),
    )
    beta: Positive = Field(
        default=1 / 9,
        description="Residual at which smooth L1 changes from quadratic to linear.",
        json_schema_extra=_unit("1"),
    )
    minimum_iou: Annotated[float, Field(ge=0, lt=1)] = Field(
        default=0.1,
        description="A prediction and a reprediction match only above this BEV IoU.",
        json_schema_extra=_unit("1"),
    )
    fuse: bool = Field(
        default=False,
        description="Whether the mean of a prediction and its matched repredictions, weighted by "
        "the squared scores, replaces the box of the label. Use 3 views or more; audit shows the "
        "share of correct boxes before and after.",
    )


class PointsSection(Section):
    """The point prior rho_diff (Eq. 8): how many LiDAR points a label of a category needs."""

    statistic: Literal["median", "mean", "quantile", "fixed"] = Field(
        default="median",
        description="How m_th is computed from the point counts of the ground-truth boxes of X_l. "
        "'fixed' uses points.fixed instead.",
    )
    quantile: Share = Field(
        default=0.5,
        description="Quantile of the point counts, for statistic = 'quantile'.",
        json_schema_extra=_unit("1"),
    )
    fixed: PointCount = Field(
        default=5.0,
        description="Threshold m_th of every category, for statistic = 'fixed'.",
        json_schema_extra=_unit("points"),
    )
    fallback: PointCount = Field(
        default=5.0,
        description="Threshold m_th of a category without ground truth in X_l.",
        json_schema_extra=_unit("points"),
    )


class SemanticSection(Section):
    """The semantic prior rho_anno (Eq. 9), from the score s and the share S/A of class pixels."""

    mean: Literal["geometric", "product", "arithmetic"] = Field(
        default="geometric",
        description="How s and S/A are combined: sqrt(s S/A), s S/A or (s + S/A) / 2.",
    )
    outside: Literal["expected", "neutral", "drop"] = Field(
        default="expected",
        description="Trust rho_anno of a box that no camera shows: 'expected' is 0.7 s^2, and such "
        "a label never outweighs the best label with image evidence; 'neutral' is s; 'drop' is 0.",
    )
    reference: bool = Field(
        default=False,
        description="Whether S/A is divided by, and capped at, its upper quartile over the labeled "
        "boxes of the category. A quartile below 0.15 is not used.",
    )


class CalibrateSection(Section):
    """How the probability that a label is correct is learned from frames with ground truth.

    Policies such as learned need it. The teacher must not have been trained on the frames.
    """

    source: Literal["auto", "calibration", "labeled", "folds"] = Field(
        default="auto",
        description="Frames to learn from: those set aside with `curate init --calibration`; "
        "labeled frames that your detector has not seen (detector.unseen); or folds of the labeled "
        "frames, each with a teacher trained on the others. 'auto' takes the first that is "
        "possible and has at least five frames.",
    )
    folds: Annotated[int, Field(ge=2)] = Field(
        default=5,
        description="Number of folds, each with a training.",
        json_schema_extra=_unit("folds"),
    )
    overlap: Literal["bev", "3d"] = Field(
        default="bev", description="Overlap with an object that makes a label correct."
    )
    thresholds: Literal["kitti", "relaxed"] = Field(
        default="relaxed",
        description="IoU that it must exceed: those of evaluation.overlaps (0.7 for Car, 0.5 for "
        "others), or relaxed ones (0.5 and 0.25).",
    )


class LearnedSection(Section):
    """The policy learned, which weights a label by the probability that it is correct."""

    precision: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.8,
        description="Requested weighted precision: the share of the weight that is on correct "
        "labels.",
        json_schema_extra=_unit("1"),
    )
    max_wrong: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        default=None,
        description="Largest expected share of wrong labels among the selected ones. With it, "
        "selected labels have weight 1 and others 0, and precision is not used. It needs frames "
        "that are set aside for calibration.",
        json_schema_extra=_unit("1"),
        examples=[0.1],
    )


class SolveSection(Section):
    """How policies weight the labels. run.method selects the policy."""

    scope: Literal["round", "category", "frame"] = Field(
        default="round",
        description="Labels that share one lambda (Eq. 4). Used by spsl and pspsl.",
    )
    quantile: Annotated[float, Field(gt=0, le=1)] | None = Field(
        default=None,
        description="Quantile of the losses that replaces max(L) in Eq. 4. Without it, the maximum "
        "is used. Used by spsl and pspsl.",
        json_schema_extra=_unit("1"),
        examples=[0.95],
    )
    self_paced: bool = Field(
        default=True,
        description="Whether pspsl uses the factor 1 - L / lambda. With false, the weight is the "
        "product of the priors, and no repredictions are needed.",
    )
    learned: LearnedSection = Field(
        default=LearnedSection(), description="Settings of the policy learned."
    )
    options: dict[PolicyName, Options] = Field(
        default={},
        description="Arguments of each policy by its name, such as {threshold = {threshold = "
        "0.4}}; see docs/methods.md.",
    )

    @model_validator(mode="before")
    @classmethod
    def _reject_policy(cls, section: Any) -> Any:
        if isinstance(section, Mapping) and "policy" in section:
            raise ValueError(f'policy has moved: write method = "{section["policy"]}" in [run]')
        return section


class TrainSection(Section):
    """How the detector is trained."""

    preset: str = Field(
        default="auto",
        description="Preset of the detector's network. 'auto' selects its first; see "
        "docs/config.md.",
    )
    pretrain_steps: AtLeastOne = Field(
        default=1200,
        description="Optimiser steps of the first teacher, on X_l.",
        json_schema_extra=_unit("steps"),
    )
    round_steps: AtLeastOne = Field(
        default=1200,
        description="Optimiser steps of the student of each round.",
        json_schema_extra=_unit("steps"),
    )
    batch_size: AtLeastOne = Field(
        default=2, description="Frames of X_l per step.", json_schema_extra=_unit("frames")
    )
    unlabeled_batch_size: Count = Field(
        default=2,
        description="Frames of X_u per step, in addition to those of X_l.",
        json_schema_extra=_unit("frames"),
    )
    learning_rate: Positive = Field(
        default=5e-3,
        description="Peak learning rate of the first teacher.",
        json_schema_extra=_unit("1"),
    )
    round_learning_rate: Positive = Field(
        default=3e-3,
        description="Peak learning rate of the students.",
        json_schema_extra=_unit("1"),
    )
    processes: AtLeastOne | Literal["auto"] = Field(
        default=1,
        description="Processes that split the frames of each step. 'auto' is one per core or GPU. "
        "At most one per frame of a step is used. The result is that of one process up to the "
        "rounding of sums; see docs/training.md.",
        json_schema_extra=_unit("processes"),
    )
    threads: AtLeastOne = Field(
        default=1,
        description="CPU threads of each process of a training.",
        json_schema_extra=_unit("threads"),
    )
    loaders: Count | Literal["auto"] = Field(
        default="auto",
        description="Processes that prepare the batches of a training ahead. 'auto': none on the "
        "CPU, else one per core but one, at most 8, or fewer if the memory is too small. They "
        "change no result.",
        json_schema_extra=_unit("processes"),
    )
    precision: Precision = Field(
        default="float32",
        description="Type of numbers in which the network computes in a training. The shorter ones "
        "save time and memory on a GPU; weights and loss stay float32.",
    )
    zero_weight: Literal["method", "ignore", "background"] = Field(
        default="method",
        description="How a student is trained on a label of weight 0. 'method': as the policy "
        "defines; see docs/methods.md.",
    )
    ignore_proposals: bool = Field(
        default=False,
        description="Whether students ignore the places of `curate propose` instead of learning "
        "them as background; see docs/review.md.",
    )
    start: Literal["teacher", "scratch"] = Field(
        default="teacher", description="Initial weights of the student of a round."
    )
    teacher: Literal["method", "student", "ema"] = Field(
        default="method",
        description="Teacher of the next round: the student or the moving average of its weights. "
        "'method': as the method defines.",
    )
    ema_decay: Annotated[float, Field(ge=0, lt=1)] = Field(
        default=0.999,
        description="Decay of the moving average per ten-thousandth of a training.",
        json_schema_extra=_unit("1"),
    )
    statistics_steps: AtLeastOne = Field(
        default=20,
        description="Steps between two points of the training curves.",
        json_schema_extra=_unit("steps"),
    )
    pasted: Count = Field(
        default=4,
        description="Objects of each category that are pasted into a frame from the object bank. "
        "0 trains without the bank.",
        json_schema_extra=_unit("objects"),
    )
    command: str | None = Field(
        default=None,
        description="Command of your own trainer, which runs in the folder of the workspace; see "
        "docs/training.md.",
        examples=["python train.py {labels} {output}"],
    )
    labels_format: ExporterName = Field(
        default="sqlite", description="Format of the labels for your own trainer."
    )
    options: Options = Field(
        default={},
        description="Further settings of curate's trainer, such as {snapshot_seconds = 60.0}.",
    )


class RunSection(Section):
    """Which method is used, and how the work is organised."""

    method: PolicyName = Field(
        default="pspsl", description="Method that weights the labels; see docs/methods.md."
    )
    rounds: AtLeastOne = Field(
        default=3, description="Number of rounds E.", json_schema_extra=_unit("rounds")
    )
    seed: Seed = Field(
        default=0,
        description="Seed of the split, the training and the augmented copies.",
        json_schema_extra=_unit("1"),
    )
    priors: Annotated[tuple[PriorName, ...], AfterValidator(_each_once)] = Field(
        default=DEFAULT_PRIORS,
        description="Priors and other sources of evidence; see docs/evidence.md.",
    )
    prior_options: dict[PriorName, Options] = Field(
        default={}, description="Arguments of each prior by its name."
    )
    executor: ExecutorName = Field(
        default="auto",
        description="Executor that processes the frames. 'auto' uses worker processes where they "
        "save time; see docs/scale.md.",
    )
    executor_options: dict[ExecutorName, Options] = Field(
        default={},
        description="Arguments of each executor by its name, such as {ray = {num_gpus = 1}}.",
    )
    workers: AtLeastOne | Literal["auto"] = Field(
        default="auto",
        description="Number of workers, each with its own copy of the model. 'auto' is one per "
        "core, or fewer if the memory is too small. More than one requires an executor other than "
        "serial.",
        json_schema_extra=_unit("workers"),
    )
    database: str | None = Field(
        default=None,
        description="SQLAlchemy URL of the database. Without it, curate.db in the workspace.",
        examples=["postgresql+psycopg://user@host/curate"],
    )


class EvaluationSection(Section):
    """When a detection or label counts as correct, and which objects count, in evaluate and audit.

    The settings change no label and no weight.
    """

    overlaps: Overlaps = Field(
        default={},
        description="IoU that a detection or label must exceed to be correct, by category, such as "
        "{Bus = 0.7}. Without an entry: 0.7 for Car, 0.5 for all others.",
    )
    difficulty: Literal["kitti", "points", "distance"] = Field(
        default="kitti",
        description="Levels of difficulty of curate evaluate: KITTI's easy, moderate and hard, "
        "which need 2D boxes; levels by LiDAR points in the object; or ranges of distance.",
    )
    minimum_points: Annotated[
        tuple[AtLeastOne, ...], Field(min_length=1), AfterValidator(_falling)
    ] = Field(
        default=(6, 1),
        description="LiDAR points that an object of each level has at least, the largest first, "
        "for difficulty = 'points'. Each level includes those before it.",
        json_schema_extra=_unit("points"),
    )
    distance_limits: Annotated[tuple[Positive, ...], AfterValidator(_strictly_rising)] = Field(
        default=(30.0, 50.0),
        description="Distances between two ranges, the smallest first, for difficulty = "
        "'distance'.",
        json_schema_extra=_unit("m"),
    )


class Config(Section):
    """The settings of a workspace."""

    dataset: DatasetSection
    detector: DetectorSection = DetectorSection()
    segmenter: SegmenterSection = SegmenterSection()
    repredict: RepredictSection = RepredictSection()
    points: PointsSection = PointsSection()
    semantic: SemanticSection = SemanticSection()
    calibrate: CalibrateSection = CalibrateSection()
    solve: SolveSection = SolveSection()
    train: TrainSection = TrainSection()
    run: RunSection = RunSection()
    evaluation: EvaluationSection = EvaluationSection()


def read_config(path: Path) -> Config:
    """Return the configuration in a TOML file.

    Raises:
        ConfigError: if the file is not TOML or settings are invalid; the message lists all of them.
    """
    if path.exists() and not path.is_file():
        raise ConfigError(f"{path}: is not a file but a folder, a pipe or a device; remove it")
    if not path.exists():
        raise ConfigError(f"{path}: no such file; `curate init` creates a workspace")
    text = read_text(path, "configuration", error_type=ConfigError)
    try:
        document = parse_toml(text)
    except (RecursionError, ValueError) as error:  # ValueError also for numbers that are too long
        raise ConfigError(f"{path}: invalid TOML: {one_line(error, 200)}") from error
    return make_config(document, str(path))


def make_config(document: Mapping[str, Any], source: str) -> Config:
    """Return the configuration in a document.

    Raises:
        ConfigError: if settings are invalid; the message lists all of them, after the source.
    """
    try:
        config = Config.model_validate(document)
    except ValidationError as error:
        raise ConfigError(f"{source}: {describe_errors(error, Config)}") from error
    try:
        overlaps_of(config.dataset.categories, config.evaluation.overlaps)
    except ConfigError as error:
        raise ConfigError(f"{source}: evaluation.overlaps: {error}") from error
    return config


def change_setting(document: dict[str, Any], setting: str) -> None:
    """Set section.key=value in a document. A value that is not valid TOML becomes a string.

    Raises:
        ConfigError: if the setting does not have this form, or its key or value is invalid.
    """
    place, equals, text = setting.partition("=")
    *sections, key = place.strip().split(".")
    if not (equals and sections and key and all(sections)):
        raise ConfigError(f"--set {setting}: write section.key=value, e.g. solve.self_paced=false")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    alone: dict[str, Any] = {"dataset": {"root": "."}}
    for each in (alone, document):
        _put(each, sections, key, value)
    try:
        Config.model_validate(alone)
    except ValidationError as error:
        raise ConfigError(f"--set {describe_errors(error, Config)}") from error


def _put(document: dict[str, Any], sections: list[str], key: str, value: Any) -> None:
    for section in sections:
        if not isinstance(document.get(section), dict):
            document[section] = {}
        document = document[section]
    document[key] = value
