"""How far weights can be trusted: as judges of right and wrong labels, against ground truth.

Every figure is NaN where it is undefined: without labels, without weight, or where all the labels
are right (or all wrong) and there is nothing to tell apart.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from curate.detections import Annotations, Detections
from curate.errors import ConfigError
from curate.geometry.overlap import bev_iou, iou_3d
from curate.shapes import Bool, Float, Int

Overlap = Literal["bev", "3d"]
Neighbors = Literal["neutral", "right"]

DONT_CARE = "DontCare"


@dataclass(frozen=True)
class JudgeSettings:
    """When a label counts as right.

    Attributes:
        overlap: BEV or 3D IoU.
        minimum_iou: per category; the IoU must exceed it. Its keys are the judged categories.
        neighbors: per category, those that look like it (KITTI's neighbour categories).
        neighbors_are: a label on a neighbour is "neutral" (neither right nor wrong) or "right".
        dont_care_share: a label whose rectangle lies in a DontCare region with more than this share
            of its area is neutral.
    """

    overlap: Overlap = "bev"
    minimum_iou: Mapping[str, float] = field(
        default_factory=lambda: {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}
    )
    neighbors: Mapping[str, tuple[str, ...]] = field(
        default_factory=lambda: {"Car": ("Van",), "Pedestrian": ("Person_sitting",)}
    )
    neighbors_are: Neighbors = "neutral"
    dont_care_share: float = 0.5

    def __post_init__(self) -> None:
        """Raise ConfigError for an unknown option."""
        if self.overlap not in get_args(Overlap):
            raise ConfigError(f"reliability: unknown overlap {self.overlap!r}; choose bev or 3d")
        if self.neighbors_are not in get_args(Neighbors):
            raise ConfigError(
                f"reliability: unknown neighbors_are {self.neighbors_are!r}; "
                "choose neutral or right",
            )


@dataclass(frozen=True)
class Judgement:
    """What the ground truth says of the n labels of one frame.

    Attributes:
        right: (n,) bool.
        counted: (n,) bool, False where a label is neutral. A right label is always counted.
        matched: (n,) int64 index of the annotation found, -1 for none.
        iou: (n,) largest IoU with an annotation of the category or a neighbour, 0 without any.
        ground_truths: number of annotations to be found, per category.
    """

    right: Bool[np.ndarray, " n"]
    counted: Bool[np.ndarray, " n"]
    matched: Int[np.ndarray, " n"]
    iou: Float[np.ndarray, " n"]
    ground_truths: Mapping[str, int]


_DEFAULT = JudgeSettings()


def judge(
    detections: Detections,
    annotations: Annotations,
    settings: JudgeSettings = _DEFAULT,
    rectangles: Float[np.ndarray, "n 4"] | None = None,
) -> Judgement:
    """Tell right from wrong labels of one frame.

    By falling score each label takes the free annotation of its category with the largest IoU above
    the minimum: a second label on the same object is wrong. A label without one that overlaps a
    neighbour, or lies in a DontCare region, is neutral; these excuse any number of labels.

    Args:
        detections: the labels, in the LiDAR frame.
        annotations: the ground truth of the frame.
        settings: see `JudgeSettings`.
        rectangles: (n, 4) left, top, right, bottom of the labels in the image, NaN where invisible;
            None leaves DontCare regions out of account.

    Raises:
        ConfigError: if a label's category has no minimum IoU.
    """
    n = len(detections)
    right, neutral = np.zeros((2, n), dtype=bool)
    matched, best = np.full(n, -1, dtype=np.int64), np.zeros(n)
    ground_truths = dict.fromkeys(settings.minimum_iou, 0)
    for category in sorted({str(name) for name in detections.categories} | set(ground_truths)):
        minimum = _minimum_iou(settings, category)
        k = np.flatnonzero(detections.categories == category)
        own, near = _own_and_neighbors(annotations, category, settings)
        ground_truths[category] = len(own)
        iou = _overlaps(detections.boxes[k], annotations.boxes[own], settings.overlap)
        near_iou = _overlaps(detections.boxes[k], annotations.boxes[near], settings.overlap)
        taken = _take_by_score(iou, detections.select(k), minimum)
        right[k] = taken >= 0
        matched[k[taken >= 0]] = own[taken[taken >= 0]]
        neutral[k] = (near_iou > minimum).any(axis=1)
        best[k] = np.concatenate([iou, near_iou, np.zeros((len(k), 1))], axis=1).max(axis=1)
    if rectangles is not None:
        neutral |= _in_dont_care(rectangles, annotations, settings.dont_care_share)
    return Judgement(right, right | ~neutral, matched, best, ground_truths)


def weighted_precision(weights: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"]) -> float:
    """Share of the (n,) weights that lies on right labels; NaN where all weights are 0."""
    return _ratio(float(weights[right].sum()), float(weights.sum()))


def weighted_recall(
    weights: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"], ground_truths: int
) -> float:
    """Weight on right labels per object to be found; NaN without objects."""
    return _ratio(float(weights[right].sum()), ground_truths)


def auroc(weights: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"]) -> float:
    """Chance that a right label weighs more than a wrong one, ties counted half."""
    value, inverse, count = np.unique(weights, return_inverse=True, return_counts=True)
    right_per_value = np.bincount(inverse[right], minlength=len(value))
    wrong_per_value = count - right_per_value
    lighter = np.cumsum(wrong_per_value) - wrong_per_value
    wins = (right_per_value * (lighter + wrong_per_value / 2)).sum()
    return _ratio(float(wins), float(right_per_value.sum()) * float(wrong_per_value.sum()))


def average_precision(weights: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"]) -> float:
    """Precision averaged over the steps in recall as the weight falls; equal weights step as one.

    NaN where no label is right.
    """
    value, inverse, count = np.unique(-weights, return_inverse=True, return_counts=True)
    found = np.bincount(inverse[right], minlength=len(value))
    precision = np.cumsum(found) / np.cumsum(count)
    return _ratio(float((found * precision).sum()), float(found.sum()))


@dataclass(frozen=True)
class ReliabilityBins:
    """Labels sorted into b bins by weight; the last bin holds its upper edge.

    Attributes:
        edges: (b + 1,).
        labels: (b,) int64 labels in the bin.
        mean_weight: (b,) NaN in an empty bin.
        precision: (b,) share of right labels, NaN in an empty bin.
        recall: (b,) right labels per object to be found, NaN without objects.
    """

    edges: Float[np.ndarray, " b_plus_1"]
    labels: Int[np.ndarray, " b"]
    mean_weight: Float[np.ndarray, " b"]
    precision: Float[np.ndarray, " b"]
    recall: Float[np.ndarray, " b"]


def reliability_bins(
    weights: Float[np.ndarray, " n"],
    right: Bool[np.ndarray, " n"],
    ground_truths: int,
    bins: int = 10,
) -> ReliabilityBins:
    """Precision and recall of the labels in bins of equal width over [0, 1]."""
    edges = np.arange(bins + 1) / bins  # the nearest numbers to 0.1, 0.2, 0.3
    member = np.clip(np.searchsorted(edges, weights, side="right") - 1, 0, bins - 1)
    labels = np.bincount(member, minlength=bins)
    found = np.bincount(member[right], minlength=bins)
    with np.errstate(invalid="ignore", divide="ignore"):
        return ReliabilityBins(
            edges=edges,
            labels=labels,
            mean_weight=np.bincount(member, weights=weights, minlength=bins) / labels,
            precision=found / labels,
            recall=found / ground_truths if ground_truths else np.full(bins, np.nan),
        )


def expected_calibration_error(
    weights: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"], bins: int = 10
) -> float:
    """Mean distance of weight and precision over the bins, by their labels; NaN without labels."""
    table = reliability_bins(weights, right, 0, bins)
    gap = np.abs(table.precision - table.mean_weight)
    return _ratio(float(np.nansum(gap * table.labels)), float(table.labels.sum()))


def _minimum_iou(settings: JudgeSettings, category: str) -> float:
    """Return the category's minimum IoU."""
    if category not in settings.minimum_iou:
        raise ConfigError(
            f"reliability: no minimum IoU for category {category}; add it to minimum_iou"
        )
    return settings.minimum_iou[category]


def _own_and_neighbors(
    annotations: Annotations, category: str, settings: JudgeSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the annotations to be found, and of those that excuse a label."""
    own = annotations.categories == category
    near = np.isin(annotations.categories, settings.neighbors.get(category, ()))
    if settings.neighbors_are == "right":
        own, near = own | near, np.zeros_like(near)
    return np.flatnonzero(own), np.flatnonzero(near)


def _overlaps(boxes: np.ndarray, others: np.ndarray, overlap: Overlap) -> np.ndarray:
    """Return (n, m) IoU."""
    iou: np.ndarray = bev_iou(boxes, others) if overlap == "bev" else iou_3d(boxes, others)
    return iou


def _take_by_score(iou: np.ndarray, rows: Detections, minimum: float) -> np.ndarray:
    """Return (n,) column that each row takes, -1 for none; rows choose by falling score."""
    taken = np.full(len(iou), -1, dtype=np.int64)
    if iou.shape[1] == 0:
        return taken
    free = np.where(iou > minimum, iou, -1.0)
    # Equal scores: the better fit chooses first, then the box decides, but never the row number.
    for row in np.lexsort((*rows.boxes.T, -iou.max(axis=1), -rows.scores)):
        column = int(free[row].argmax())
        if free[row, column] >= 0:
            taken[row] = column
            free[:, column] = -1.0
    return taken


def _in_dont_care(rectangles: np.ndarray, annotations: Annotations, share: float) -> np.ndarray:
    """Return (n,) bool, whether more than `share` of the rectangle lies in one DontCare region."""
    regions = annotations.boxes_2d[annotations.categories == DONT_CARE]
    low = np.maximum(rectangles[:, None, :2], regions[None, :, :2])
    high = np.minimum(rectangles[:, None, 2:], regions[None, :, 2:])
    common = np.prod(np.maximum(high - low, 0.0), axis=2)
    area = np.prod(rectangles[:, 2:] - rectangles[:, :2], axis=1)
    return np.asarray((common > share * area[:, None]).any(axis=1))


def _ratio(part: float, whole: float) -> float:
    """Part / whole, NaN where the whole is 0."""
    return part / whole if whole else float("nan")
