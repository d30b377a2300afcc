"""The point prior rho_diff (Eq. 8): boxes with few LiDAR points are trusted less.

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
from curate.ranges import AboveZero
from curate.shapes import Float, Num

logger = logging.getLogger(__name__)

Statistic = Literal["median", "mean", "quantile", "fixed"]


@dataclass(frozen=True)
class PointSettings:
    """Settings of the threshold m_th(c), from the ground truth of category c in X_l.

    Attributes:
        statistic: statistic of the point counts of c's ground-truth boxes; "fixed" uses the value
            of `fixed` instead.
        quantile: quantile in [0, 1], for the statistic "quantile".
        fixed: number of points, for the statistic "fixed".
        fallback: m_th of a category without ground truth in X_l, in points.
    """

    statistic: Statistic = "median"
    quantile: float = 0.5
    fixed: float = 5.0
    fallback: float = 5.0

    def __post_init__(self) -> None:
        """Raise ConfigError if a setting is out of its range."""
        if self.statistic not in get_args(Statistic):
            choices = ", ".join(get_args(Statistic))
            raise ConfigError(
                f"point prior: unknown statistic {self.statistic!r}; choose one of {choices}"
            )
        if not 0 <= self.quantile <= 1:
            raise ConfigError(f"point prior: quantile must be in [0, 1], not {self.quantile}")
        if not (self.fixed >= 1 and self.fallback >= 1):
            raise ConfigError("point prior: fixed and fallback must be at least 1 point")


_DEFAULT = PointSettings()


def points_threshold(
    counts_per_ground_truth: Num[np.ndarray, " g"], settings: PointSettings = _DEFAULT
) -> float:
    """Return m_th of one category; it is at least 1, so a box without points has rho_diff 0.

    Args:
        counts_per_ground_truth: (g,) LiDAR points inside each ground-truth box of the category.
        settings: statistic and fallback; the fallback is returned if g = 0.
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
    """Return (n,) rho_diff (Eq. 8) from (n,) point counts m and (n,) thresholds m_th."""
    rho: np.ndarray = np.minimum(points, thresholds) / thresholds
    return rho


def learn_thresholds(
    samples: Iterable[tuple[Frame, Annotations]],
    categories: Sequence[str],
    settings: PointSettings = _DEFAULT,
) -> dict[str, float]:
    """Return m_th of each category from labeled frames; warns of categories without ground truth.

    Args:
        samples: frames of X_l, never of X_u, with their ground truth. Crop their points in the same
            way as those of the frames to be scored.
        categories: categories that need a threshold.
        settings: see `PointSettings`.
    """
    counts: dict[str, list[np.ndarray]] = {category: [] for category in categories}
    for frame, annotations in samples:
        selected = annotations.select(np.isin(annotations.categories, list(categories)))
        inside = count_points_in_boxes(frame.points, selected.boxes)
        for category, of_category in counts.items():
            of_category.append(inside[selected.categories == category])
    merged = {c: np.concatenate([np.zeros(0), *parts]) for c, parts in counts.items()}
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

    thresholds: Mapping[str, AboveZero]
    name: ClassVar[str] = "points"
    columns: ClassVar[tuple[Column, ...]] = (
        Column("points", "int32", "1", "m, LiDAR points in the box"),
        Column("points_threshold", "float64", "1", "m_th, threshold learned from labeled boxes"),
        Column("rho_diff", "float64", "1", "point prior, Eq. 8: min(m, m_th) / m_th"),
    )
    rho_column: ClassVar[str | None] = "rho_diff"
    measured_columns: ClassVar[tuple[str, ...]] = ("points",)

    def __post_init__(self) -> None:
        """Raise ConfigError if a threshold is not a positive number."""
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
        """Return the point counts, the thresholds and rho_diff.

        Raises:
            ConfigError: if a detection's category has no threshold.
        """
        points, threshold = measured["points"], self._threshold_per_label(detections.categories)
        rho = point_trust(points, threshold)
        return {"points": points, "points_threshold": threshold, "rho_diff": rho}

    def describe(self, row: Mapping[str, Any]) -> str:
        """Return Eq. 8 with the numbers of one label."""
        return (
            "Eq. 8: rho_diff = min({points}, {points_threshold}) / {points_threshold} = {rho_diff}"
        ).format(**row)

    def _threshold_per_label(self, categories: np.ndarray) -> np.ndarray:
        """Return the (n,) float64 threshold of each label."""
        names, inverse = np.unique(categories, return_inverse=True)
        unknown = [str(name) for name in names if name not in self.thresholds]
        if unknown:
            raise ConfigError(
                f"point prior: no threshold for category {', '.join(unknown)}; "
                "add it to the configured categories and learn the thresholds again",
            )
        return np.array([self.thresholds[str(name)] for name in names], dtype=np.float64)[inverse]
