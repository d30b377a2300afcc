"""The point prior rho_diff (Eq. 8): a box with few LiDAR points in it is hard to be sure of.

Source: An et al., Remote Sensing 15(3):627, 2023.
"""

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from curate.detections import Annotations, Detections
from curate.errors import ConfigError
from curate.frames import Frame
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.priors.base import Column, Evidence, EvidenceSource, Measured
from curate.shapes import Float, Num

logger = logging.getLogger(__name__)

Statistic = Literal["median", "mean", "quantile", "fixed"]


@dataclass(frozen=True)
class PointSettings:
    """How m_th(c) follows from the ground truth of category c in X_l.

    Attributes:
        statistic: of the point counts of c's ground-truth boxes; "fixed" uses `fixed` and looks at
            none of them.
        quantile: for "quantile", in [0, 1].
        fixed: for "fixed", in points.
        fallback: m_th of a category without ground truth in X_l, in points.
    """

    statistic: Statistic = "median"
    quantile: float = 0.5
    fixed: float = 5.0
    fallback: float = 5.0

    def __post_init__(self) -> None:
        """Raise ConfigError for a setting without meaning."""
        if self.statistic not in get_args(Statistic):
            known = ", ".join(get_args(Statistic))
            raise ConfigError(
                f"point prior: unknown statistic {self.statistic!r}; choose one of {known}"
            )
        if not 0 <= self.quantile <= 1:
            raise ConfigError(f"point prior: quantile must be in [0, 1], not {self.quantile}")
        if not (self.fixed >= 1 and self.fallback >= 1):
            raise ConfigError("point prior: fixed and fallback must be at least 1 point")


_DEFAULT = PointSettings()


def points_threshold(
    counts_per_ground_truth: Num[np.ndarray, " g"], settings: PointSettings = _DEFAULT
) -> float:
    """m_th of one category, at least 1 so that a box without a point is never trusted.

    Args:
        counts_per_ground_truth: (g,) LiDAR points inside each ground-truth box of the category.
        settings: which statistic; its fallback is the answer for g = 0.
    """
    if settings.statistic == "fixed":
        return float(settings.fixed)
    if len(counts_per_ground_truth) == 0:
        return float(settings.fallback)
    if settings.statistic == "mean":
        value = np.mean(counts_per_ground_truth)
    else:
        share = 0.5 if settings.statistic == "median" else settings.quantile
        value = np.quantile(counts_per_ground_truth, share)
    return max(float(value), 1.0)


def point_trust(
    points: Num[np.ndarray, " n"], thresholds: Num[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """rho_diff (Eq. 8) from (n,) point counts m and (n,) thresholds m_th."""
    rho: np.ndarray = np.minimum(points, thresholds) / thresholds
    return rho


def learn_thresholds(
    samples: Iterable[tuple[Frame, Annotations]],
    categories: Sequence[str],
    settings: PointSettings = _DEFAULT,
) -> dict[str, float]:
    """m_th of each category from labeled frames; warns for a category without ground truth.

    Args:
        samples: the frames of X_l, never of X_u, with their ground truth. Their points must be
            cropped, or not, as those of the frames that will be scored.
        categories: which categories need a threshold.
        settings: see `PointSettings`.
    """
    counts: dict[str, list[np.ndarray]] = {category: [] for category in categories}
    for frame, annotations in samples:
        wanted = annotations.select(np.isin(annotations.categories, list(categories)))
        inside = count_points_in_boxes(frame.points, wanted.boxes)
        for category, found in counts.items():
            found.append(inside[wanted.categories == category])
    merged = {c: np.concatenate([np.zeros(0), *found]) for c, found in counts.items()}
    missing = [] if settings.statistic == "fixed" else [c for c, m in merged.items() if not len(m)]
    for category in missing:
        logger.warning(
            "point prior: no ground truth of %s in the labeled frames; its threshold is the "
            "fallback of %g points",
            category,
            settings.fallback,
        )
    return {c: points_threshold(m, settings) for c, m in merged.items()}


@dataclass(frozen=True)
class PointPrior(EvidenceSource):
    """rho_diff = min(m, m_th(c)) / m_th(c).

    Attributes:
        thresholds: m_th per category, in points; see `learn_thresholds`.
    """

    thresholds: Mapping[str, float]
    name: ClassVar[str] = "points"
    columns: ClassVar[tuple[Column, ...]] = (
        Column("points", "int32", "1", "m, LiDAR points in the box"),
        Column("points_threshold", "float64", "1", "m_th, what labeled boxes of the category hold"),
        Column("rho_diff", "float64", "1", "point prior, Eq. 8: min(m, m_th) / m_th"),
    )
    rho_column: ClassVar[str | None] = "rho_diff"
    measured_columns: ClassVar[tuple[str, ...]] = ("points",)

    def __post_init__(self) -> None:
        """Raise ConfigError where a threshold is not a positive number."""
        for category, value in self.thresholds.items():
            if not (np.isfinite(value) and value > 0):
                raise ConfigError(
                    f"point prior: the threshold of {category} must be positive, not {value}"
                )

    def measure(self, frame: Frame, detections: Detections) -> Measured:
        """Count the points of the frame in each box."""
        counts = count_points_in_boxes(frame.points, detections.boxes)
        return {"points": np.asarray(counts, dtype=np.int64)}

    def rate(self, detections: Detections, measured: Measured) -> Evidence:
        """Compare the counts with the threshold.

        Raises:
            ConfigError: if a detection's category has no threshold.
        """
        points, threshold = measured["points"], self._threshold_per_label(detections.categories)
        rho = point_trust(points, threshold)
        return {"points": points, "points_threshold": threshold, "rho_diff": rho}

    def describe(self, row: Mapping[str, Any]) -> str:
        """Return Eq. 8 with the numbers of a label."""
        return (
            "Eq. 8: rho_diff = min({points}, {points_threshold}) / {points_threshold} = {rho_diff}"
        ).format(**row)

    def _threshold_per_label(self, categories: np.ndarray) -> np.ndarray:
        """Return (n,) float64."""
        names, inverse = np.unique(categories, return_inverse=True)
        unknown = [str(name) for name in names if name not in self.thresholds]
        if unknown:
            raise ConfigError(
                f"point prior: no threshold for category {', '.join(unknown)}; "
                "add it to the configured categories and learn the thresholds again",
            )
        return np.array([self.thresholds[str(name)] for name in names], dtype=np.float64)[inverse]
