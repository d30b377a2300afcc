"""The reliability of label weights: how well they separate correct labels from wrong ones.

Correct and wrong are decided by matching the labels to ground truth. A figure is NaN where it is
undefined: without labels, without weight, or if all labels are correct or all are wrong. Weights
that were not measured are NaN, and so is every figure of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from curate.detections import Annotations, Detections
from curate.errors import ConfigError
from curate.evaluation.kitti_rules import MIN_OVERLAPS, NEIGHBOURS
from curate.geometry.overlap import bev_iou, iou_3d
from curate.shapes import Bool, Float, Int, Shaped

Overlap = Literal["bev", "3d"]
Neighbors = Literal["neutral", "correct"]

DONT_CARE = "DontCare"

NEUTRAL = ("neighbour", "DontCare region")
"""Why a label is neither correct nor wrong."""


@dataclass(frozen=True)
class MatchSettings:
    """The rules by which a label is correct, wrong or neutral.

    Attributes:
        overlap: the overlap to match by, BEV or 3D IoU.
        minimum_iou: IoU threshold per category, which a correct label must exceed. Its keys are the
            evaluated categories.
        neighbors: per category, the categories that look like it (KITTI's neighbour categories).
        neighbors_are: whether a label on a neighbour is "neutral" (neither correct nor wrong) or
            "correct".
        dont_care_share: a label is neutral if more than this share of its rectangle in the image
            lies in a DontCare region.
    """

    overlap: Overlap = "bev"
    minimum_iou: Mapping[str, float] = field(default_factory=lambda: dict(MIN_OVERLAPS))
    neighbors: Mapping[str, tuple[str, ...]] = field(
        default_factory=lambda: {name: (other,) for name, other in NEIGHBOURS.items()}
    )
    neighbors_are: Neighbors = "neutral"
    dont_care_share: float = 0.5

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            ConfigError: if an option has an unknown value.
        """
        if self.overlap not in get_args(Overlap):
            raise ConfigError(f"reliability: unknown overlap {self.overlap!r}; choose bev or 3d")
        if self.neighbors_are not in get_args(Neighbors):
            raise ConfigError(
                f"reliability: unknown neighbors_are {self.neighbors_are!r}; "
                "choose neutral or correct",
            )


@dataclass(frozen=True)
class LabelMatches:
    """The result of matching the n labels of one frame to its ground truth.

    Attributes:
        correct: (n,) bool.
        counted: (n,) bool, False for neutral labels. A correct label is always counted.
        neutral: (n,) str, why a label is neutral, one of `NEUTRAL`; "" for counted labels.
        matched: (n,) int64 index of the matched annotation, -1 for none.
        iou: (n,) largest IoU with an annotation of the category or a neighbour, 0 without any.
        ground_truths: number of annotations to find, per category.
    """

    correct: Bool[np.ndarray, " n"]
    counted: Bool[np.ndarray, " n"]
    neutral: Shaped[np.ndarray, " n"]
    matched: Int[np.ndarray, " n"]
    iou: Float[np.ndarray, " n"]
    ground_truths: Mapping[str, int]


_DEFAULT = MatchSettings()


def match_to_ground_truth(
    detections: Detections,
    annotations: Annotations,
    settings: MatchSettings = _DEFAULT,
    rectangles: Float[np.ndarray, "n 4"] | None = None,
) -> LabelMatches:
    """Return which labels of one frame are correct, wrong or neutral.

    The labels are matched in the order of falling score. Each takes the free annotation of its
    category with the largest IoU above the minimum and is then correct. A second label on the same
    object is therefore wrong. A label without a match is neutral if it overlaps an object of a
    neighbour category or lies in a DontCare region; any number of labels may do so.

    Args:
        detections: the labels, in the LiDAR frame.
        annotations: the ground truth of the frame.
        settings: see `MatchSettings`.
        rectangles: (n, 4) left, top, right, bottom of the labels in the image, in pixels; NaN for
            labels outside the image. None ignores DontCare regions.

    Raises:
        ConfigError: if a label's category has no minimum IoU.
    """
    n = len(detections)
    correct, on_neighbor, in_region = np.zeros((3, n), dtype=bool)
    matched, best = np.full(n, -1, dtype=np.int64), np.zeros(n)
    ground_truths = dict.fromkeys(settings.minimum_iou, 0)
    for category in sorted({str(name) for name in detections.categories} | set(ground_truths)):
        minimum = _minimum_iou(settings, category)
        k = np.flatnonzero(detections.categories == category)
        targets, neighbors = _targets_and_neighbors(annotations, category, settings)
        ground_truths[category] = len(targets)
        iou = _overlaps(detections.boxes[k], annotations.boxes[targets], settings.overlap)
        neighbor_iou = _overlaps(
            detections.boxes[k], annotations.boxes[neighbors], settings.overlap
        )
        taken = _take_by_score(iou, detections.select(k), minimum)
        correct[k] = taken >= 0
        matched[k[taken >= 0]] = targets[taken[taken >= 0]]
        on_neighbor[k] = (neighbor_iou > minimum).any(axis=1)
        best[k] = np.concatenate([iou, neighbor_iou, np.zeros((len(k), 1))], axis=1).max(axis=1)
    if rectangles is not None:
        in_region = _in_dont_care(rectangles, annotations, settings.dont_care_share)
    neutral = np.select([correct, on_neighbor, in_region], ["", *NEUTRAL], default="")
    return LabelMatches(correct, neutral == "", neutral, matched, best, ground_truths)


def weighted_precision(weights: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"]) -> float:
    """Return the share of the (n,) weights that is on correct labels; NaN if all weights are 0."""
    return _ratio(float(weights[correct].sum()), float(weights.sum()))


def weighted_recall(
    weights: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"], ground_truths: int
) -> float:
    """Return the sum of the weights of correct labels per object; NaN without objects."""
    return _ratio(float(weights[correct].sum()), ground_truths)


def rank_labels(weights: Float[np.ndarray, " n"]) -> bool:
    """Return whether weights rank labels: they were measured, and some are not 0.

    The AUROC of weights that are all 0 is 1/2 by its definition, which says nothing about a policy
    that trusts no label. Reports leave it out.
    """
    return bool(weights.any()) and not bool(np.isnan(weights).any())


def auroc(weights: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"]) -> float:
    """Return the probability that a correct label weighs more than a wrong one; ties count half.

    NaN if no label is correct, none is wrong, or weights were not measured.
    """
    if np.isnan(weights).any():
        return float("nan")
    value, inverse, count = np.unique(weights, return_inverse=True, return_counts=True)
    correct_per_value = np.bincount(inverse[correct], minlength=len(value))
    wrong_per_value = count - correct_per_value
    lighter = np.cumsum(wrong_per_value) - wrong_per_value
    wins = (correct_per_value * (lighter + wrong_per_value / 2)).sum()
    return _ratio(float(wins), float(correct_per_value.sum()) * float(wrong_per_value.sum()))


def average_precision(weights: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"]) -> float:
    """Return the average precision of the labels ranked by falling weight.

    This is the mean precision over the steps in recall; labels of equal weight form one step. NaN
    if no label is correct, or weights were not measured.
    """
    if np.isnan(weights).any():
        return float("nan")
    value, inverse, count = np.unique(-weights, return_inverse=True, return_counts=True)
    found = np.bincount(inverse[correct], minlength=len(value))
    precision = np.cumsum(found) / np.cumsum(count)
    return _ratio(float((found * precision).sum()), float(found.sum()))


@dataclass(frozen=True)
class ReliabilityBins:
    """Labels sorted into b bins by weight; the last bin includes its upper edge.

    Attributes:
        edges: (b + 1,) edges of the bins.
        labels: (b,) int64 number of labels.
        mean_weight: (b,) mean weight, NaN in an empty bin.
        precision: (b,) share of correct labels, NaN in an empty bin.
        recall: (b,) correct labels per object, NaN without objects.
    """

    edges: Float[np.ndarray, " b_plus_1"]
    labels: Int[np.ndarray, " b"]
    mean_weight: Float[np.ndarray, " b"]
    precision: Float[np.ndarray, " b"]
    recall: Float[np.ndarray, " b"]


def reliability_bins(
    weights: Float[np.ndarray, " n"],
    correct: Bool[np.ndarray, " n"],
    ground_truths: int,
    bins: int = 10,
) -> ReliabilityBins:
    """Return the precision and recall of the labels in bins of equal width over [0, 1].

    Labels with a weight of NaN are in no bin, and the recall is then NaN.
    """
    measured = ~np.isnan(weights)
    if not measured.all():
        weights, correct, ground_truths = weights[measured], correct[measured], 0
    member = bin_of(weights, bins)
    labels = np.bincount(member, minlength=bins)
    found = np.bincount(member[correct], minlength=bins)
    with np.errstate(invalid="ignore", divide="ignore"):
        return ReliabilityBins(
            edges=np.arange(bins + 1) / bins,
            labels=labels,
            mean_weight=np.bincount(member, weights=weights, minlength=bins) / labels,
            precision=found / labels,
            recall=found / ground_truths if ground_truths else np.full(bins, np.nan),
        )


def expected_calibration_error(
    weights: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"], bins: int = 10
) -> float:
    """Return the mean |weight - precision| over the bins, by number of labels; NaN without any."""
    if np.isnan(weights).any():
        return float("nan")
    table = reliability_bins(weights, correct, 0, bins)
    gap = np.abs(table.precision - table.mean_weight)
    return _ratio(float(np.nansum(gap * table.labels)), float(table.labels.sum()))


def chance_calibration_errors(
    weights: Float[np.ndarray, " n"],
    generator: np.random.Generator,
    simulations: int = 1000,
    bins: int = 10,
) -> Float[np.ndarray, " s"]:
    """Return calibration errors that perfectly calibrated weights would have by chance alone.

    Label i is then correct with probability v_i, independently of the others. The error is not 0,
    because few labels in a bin are hardly ever correct in exactly the share of their mean weight.
    The number of correct labels in a bin is a sum of Bernoulli variables, and is drawn from the
    binomial distribution with the same mean and the same variance.

    Args:
        weights: (n,) in [0, 1]; NaN if they were not measured.
        generator: random generator of the simulations.
        simulations: number of simulations, s.
        bins: as in `expected_calibration_error`.

    Returns:
        (s,) calibration errors, NaN without labels or if weights were not measured.
    """
    if not len(weights) or np.isnan(weights).any():
        return np.full(simulations, np.nan)
    member = bin_of(weights, bins)
    mean = np.bincount(member, weights, minlength=bins)
    squares = np.bincount(member, weights**2, minlength=bins)
    # mean = m q and variance = mean - squares = m q (1 - q) of m trials with probability q.
    some = mean > 0
    trials = np.zeros(bins, dtype=np.int64)
    trials[some] = np.ceil(np.round(mean[some] ** 2 / squares[some], 6))
    share = np.divide(mean, trials, out=np.zeros(bins), where=some)
    drawn = generator.binomial(trials, np.minimum(share, 1.0), (simulations, bins))
    return np.asarray(np.abs(drawn - mean).sum(axis=1) / len(weights))


def bin_of(weights: Float[np.ndarray, " n"], bins: int) -> Int[np.ndarray, " n"]:
    """Return the bin of each weight; see `reliability_bins`."""
    # Unlike np.linspace, this gives the floats nearest to 0.1, 0.2, 0.3.
    edges = np.arange(bins + 1) / bins
    return np.clip(np.searchsorted(edges, weights, side="right") - 1, 0, bins - 1)


def _minimum_iou(settings: MatchSettings, category: str) -> float:
    if category not in settings.minimum_iou:
        raise ConfigError(
            f"reliability: no minimum IoU for category {category}; add it to minimum_iou"
        )
    return settings.minimum_iou[category]


def _targets_and_neighbors(
    annotations: Annotations, category: str, settings: MatchSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the annotations to find, and of those that make a label neutral."""
    targets = annotations.categories == category
    neighbors = np.isin(annotations.categories, settings.neighbors.get(category, ()))
    if settings.neighbors_are == "correct":
        targets, neighbors = targets | neighbors, np.zeros_like(neighbors)
    return np.flatnonzero(targets), np.flatnonzero(neighbors)


def _overlaps(boxes: np.ndarray, others: np.ndarray, overlap: Overlap) -> np.ndarray:
    """Return (n, m) IoU of every pair."""
    iou: np.ndarray = bev_iou(boxes, others) if overlap == "bev" else iou_3d(boxes, others)
    return iou


def _take_by_score(iou: np.ndarray, rows: Detections, minimum: float) -> np.ndarray:
    """Return (n,) the column that each row takes, -1 for none; rows choose by falling score."""
    taken = np.full(len(iou), -1, dtype=np.int64)
    if iou.shape[1] == 0:
        return taken
    free = np.where(iou > minimum, iou, -1.0)
    # At equal scores the greater IoU goes first, then the box decides: the result must not depend
    # on the order of the rows.
    for row in np.lexsort((*rows.boxes.T, -iou.max(axis=1), -rows.scores)):
        column = int(free[row].argmax())
        if free[row, column] >= 0:
            taken[row] = column
            free[:, column] = -1.0
    return taken


def _in_dont_care(rectangles: np.ndarray, annotations: Annotations, share: float) -> np.ndarray:
    """Return (n,) bool, True if more than `share` of a rectangle lies in one DontCare region."""
    regions = annotations.boxes_2d[annotations.categories == DONT_CARE]
    low = np.maximum(rectangles[:, None, :2], regions[None, :, :2])
    high = np.minimum(rectangles[:, None, 2:], regions[None, :, 2:])
    common = np.prod(np.maximum(high - low, 0.0), axis=2)
    area = np.prod(rectangles[:, 2:] - rectangles[:, :2], axis=1)
    return np.asarray((common > share * area[:, None]).any(axis=1))


def _ratio(part: float, whole: float) -> float:
    """Return part / whole, NaN if the whole is 0."""
    return part / whole if whole else float("nan")
