"""The features of a label, from which a calibration computes the probability that it is correct.

The evidence is that of the paper's weight, and more of it: the score s, the consistency loss L, the
points in the box m, their prior rho_diff, the share S/A of class pixels, and the box itself.

Example: a car of size (4.0, 1.6, 1.5) m at (30, 40) m, with the mean size (4.4, 1.6, 1.5) m:

    s = 0.9       score       ln(0.9 / 0.1) = 2.197
    L = 0.1       loss        -ln 0.1 = 2.303        matched    1
    m = 19        points      ln 20 = 2.996
    rho = 0.5     rho_diff    ln 0.5 = -0.693
    S/A = 0.8     pixels      0.8
                  distance    50 / 10 = 5            size       |ln(4.0 / 4.4)| = 0.095
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from curate.errors import ConfigError, DataError
from curate.shapes import Float, Shaped

MATCHED = "matched"
_SCORE_RANGE = (1e-4, 1.0 - 1e-4)
_LOSS_RANGE = (0.02, 20.0)
_LEAST_RHO = 1e-3
_METRES_PER_DISTANCE = 10.0
_CORE = ("score", "loss", MATCHED, "points", "rho_diff", "pixels", "distance", "size")


@dataclass(frozen=True)
class LabelEvidence:
    """The evidence of n labels, as aligned columns. NaN stands for evidence that a label lacks.

    Attributes:
        category: (n,) str.
        score: (n,) s, in [0, 1].
        loss: (n,) consistency loss L; NaN if no reprediction matched.
        points: (n,) LiDAR points in the box, m.
        rho_diff: (n,) trust of the point prior, in [0, 1].
        pixel_share: (n,) S/A, share of class pixels; NaN outside the image or without a segmenter.
        boxes: (n, 7) in the LiDAR frame.
        further: (n,) columns of further evidence by name, such as that of tracks.
    """

    category: Shaped[np.ndarray, " n"]
    score: Float[np.ndarray, " n"]
    loss: Float[np.ndarray, " n"]
    points: Float[np.ndarray, " n"]
    rho_diff: Float[np.ndarray, " n"]
    pixel_share: Float[np.ndarray, " n"]
    boxes: Float[np.ndarray, "n 7"]
    further: Mapping[str, Float[np.ndarray, " n"]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise DataError if a column is not aligned or infinite, or a score or box is missing."""
        for name, column in self.columns().items():
            if len(column) != len(self):
                raise DataError(
                    f"evidence: column {name} has {len(column)} labels, score has {len(self)}; "
                    "give one value per label"
                )
            required = name in ("score", "boxes")
            if required and not np.isfinite(column).all():
                raise DataError(f"evidence: {name} of a label is missing or infinite")
            if name != "category" and np.isinf(column).any():
                raise DataError(f"evidence: {name} of a label is infinite")

    def __len__(self) -> int:
        return len(self.score)

    def columns(self) -> dict[str, np.ndarray]:
        """Return all columns by name."""
        return {
            "category": self.category,
            "score": self.score,
            "loss": self.loss,
            "points": self.points,
            "rho_diff": self.rho_diff,
            "pixel_share": self.pixel_share,
            "boxes": self.boxes,
            **self.further,
        }

    @classmethod
    def joined(cls, parts: Sequence["LabelEvidence"]) -> "LabelEvidence":
        """Return the labels of all parts, which have the same further columns."""
        if not parts:
            none = np.zeros(0)
            return cls(np.zeros(0, np.str_), none, none, none, none, none, np.zeros((0, 7)))
        columns = {
            name: np.concatenate([part.columns()[name] for part in parts])
            for name in parts[0].columns()
        }
        further = {name: columns.pop(name) for name in parts[0].further}
        return cls(**columns, further=further)

    def select(self, rows: np.ndarray) -> "LabelEvidence":
        """Return the labels at `rows` (integers or a mask), in that order."""
        further = {name: column[rows] for name, column in self.further.items()}
        columns = {name: column[rows] for name, column in self.columns().items()}
        own = {name: column for name, column in columns.items() if name not in further}
        return LabelEvidence(**own, further=further)


def feature_names(categories: Sequence[str], further: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of the features, in the order of `features`."""
    return (*_CORE, *categories, *further)


def features(
    evidence: LabelEvidence,
    categories: Sequence[str],
    sizes: Mapping[str, Sequence[float]],
    further: Sequence[str] = (),
) -> Float[np.ndarray, "n f"]:
    """Return the features of every label; NaN where the label lacks the evidence.

    A label without a matched reprediction has the greatest loss that is distinguished, and 0 in the
    feature "matched": that no view matched is evidence too.

    Args:
        evidence: the labels.
        categories: the categories, one feature each: 1 for a label of the category, else 0.
        sizes: logarithms of the mean length, width and height per category, see `mean_log_sizes`.
        further: names of the columns of further evidence.

    Raises:
        ConfigError: if a label has another category, or the evidence lacks a column of `further` or
            has one more.
    """
    unknown = sorted(set(np.unique(evidence.category).tolist()) - set(categories))
    if unknown:
        raise ConfigError(
            f"a label is a {unknown[0]}, but the calibration knows {', '.join(categories)}; "
            "run `curate calibrate` again"
        )
    if set(further) != set(evidence.further):
        raise ConfigError(
            f"the calibration was fitted to the further evidence {', '.join(further) or 'none'}, "
            f"but the labels have {', '.join(evidence.further) or 'none'}; run `curate calibrate` "
            "again"
        )
    score = np.clip(evidence.score, *_SCORE_RANGE)
    matched = ~np.isnan(evidence.loss)
    loss = np.where(matched, np.clip(evidence.loss, *_LOSS_RANGE), _LOSS_RANGE[1])
    columns = (
        np.log(score / (1.0 - score)),
        -np.log(loss),
        matched,
        np.log1p(evidence.points),
        np.log(np.maximum(evidence.rho_diff, _LEAST_RHO)),
        evidence.pixel_share,
        np.hypot(evidence.boxes[:, 0], evidence.boxes[:, 1]) / _METRES_PER_DISTANCE,
        _size_deviation(evidence, sizes),
        *(evidence.category == name for name in categories),
        *(evidence.further[name] for name in further),
    )
    return np.stack([np.asarray(column, dtype=np.float64) for column in columns], axis=1)


def mean_log_sizes(
    category: Shaped[np.ndarray, " n"], boxes: Float[np.ndarray, "n 7"]
) -> dict[str, tuple[float, float, float]]:
    """Return the logarithms of the geometric mean length, width and height of each category.

    Args:
        category: category of each object of X_l.
        boxes: their boxes; those with a size of 0 are left out.
    """
    valid = (boxes[:, 3:6] > 0).all(axis=1)
    sizes = {}
    for name in np.unique(category[valid]).tolist():
        length, width, height = np.log(boxes[valid & (category == name), 3:6]).mean(axis=0).tolist()
        sizes[name] = (length, width, height)
    return sizes


def _size_deviation(
    evidence: LabelEvidence, sizes: Mapping[str, Sequence[float]]
) -> Float[np.ndarray, " n"]:
    """Return the sum over the sizes of |ln(size / mean)|; NaN for a category without a mean."""
    deviation = np.full(len(evidence), np.nan)
    for name, mean in sizes.items():
        rows = evidence.category == name
        logs = np.log(np.maximum(evidence.boxes[rows, 3:6], np.finfo(np.float64).tiny))
        deviation[rows] = np.abs(logs - np.asarray(mean)).sum(axis=1)
    return deviation
