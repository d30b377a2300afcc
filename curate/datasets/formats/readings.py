"""How many columns do the numbers of a file without a header have?

A file of 440 points with five columns has as many bytes as one of 550 points with four. The right
number of columns shows in the values:

- The columns differ in size: x and y are tens of metres, z a few metres, intensities 0 to 1, rings
  0 to 63. With the right number of columns, a large share of the variance of log(1 + |value|) is
  between the columns. With a wrong one, every column is a mixture of all true ones, so the columns
  are alike, and the share is near 0.
- The fourth column is the intensity, which is never negative. In a wrong reading it contains y and
  z, about half of which are negative.

Twice the true number of columns explains the variance just as well: each row holds two points. Such
a reading counts only if its second half does not look like a point.
"""

from collections.abc import Sequence

import numpy as np

from curate.shapes import Float

CANDIDATES = range(3, 11)
# The least common multiple of the candidates: blocks of this length begin with the first column
# in every reading. A few of them are enough, and much faster than the whole file.
_BLOCK = 2520
_BLOCKS = 5
# By how much another reading must explain the variance better. The right readings of KITTI's,
# nuScenes' and simulated sweeps explain 0.5 to 0.8, wrong ones below 0.05.
_MARGIN = 0.1
# A share of invalid values that real files contain.
_TOLERATED = 0.001
_MAX_COORDINATE = 2000.0


def better_readings(
    values: Float[np.ndarray, " n"], columns: int, *, least_rows: int = 1
) -> tuple[int, ...]:
    """Return the numbers of columns that fit the values clearly better than `columns`.

    The best one comes first.

    Args:
        values: all numbers of the file, in its order.
        columns: the number of columns to compare with; the values need not be divisible by it.
        least_rows: readings with fewer rows are not considered; a few rows may look like anything.
    """
    sample = _sample(values)
    sizes = np.log1p(np.minimum(np.abs(np.nan_to_num(sample)), 1e6))
    limit = _explained(sizes, columns) + _MARGIN
    shares = {
        candidate: _explained(sizes, candidate)
        for candidate in fitting(len(values))
        if candidate != columns and len(values) // candidate >= least_rows
    }
    better = {
        candidate: share
        for candidate, share in shares.items()
        if share > limit
        and _may_be_points(sample.reshape(-1, candidate))
        and not _repeats(sample, candidate, columns)
    }
    # A multiple of the true number explains no more than it.
    distinct = [
        each
        for each, share in better.items()
        if not any(
            share < better[other] + _MARGIN and _repeats(sample, each, other) for other in better
        )
    ]
    return tuple(sorted(distinct, key=lambda each: -better[each]))


def fitting(count: int) -> Sequence[int]:
    """Return the candidates by which the count of values is divisible."""
    return [candidate for candidate in CANDIDATES if count and count % candidate == 0]


def _sample(values: np.ndarray) -> np.ndarray:
    """Return the values, or some blocks of them if there are many."""
    blocks = len(values) // _BLOCK
    if blocks <= _BLOCKS:
        return values
    starts = np.linspace(0, blocks - 1, _BLOCKS).astype(int) * _BLOCK
    return np.concatenate([values[start : start + _BLOCK] for start in starts.tolist()])


def _explained(sizes: np.ndarray, columns: int) -> float:
    """Return the share of the variance between columns, adjusted for chance (adjusted R squared).

    It is 0 if there are not enough values to tell.
    """
    table = sizes[: len(sizes) // columns * columns].reshape(-1, columns)
    total = float(table.var()) if table.size else 0.0
    if len(table) < 2 or total == 0:
        return 0.0
    unexplained = 1 - float(table.mean(axis=0).var()) / total
    return 1 - unexplained * (table.size - 1) / (table.size - columns)


def _may_be_points(rows: np.ndarray) -> bool:
    """Return whether the rows may be x, y, z, intensity and others."""
    known = rows[np.isfinite(rows[:, :4]).all(axis=1)]
    if len(known) == 0:
        return False
    bad = (np.abs(known[:, :3]) > _MAX_COORDINATE).any(axis=1)
    if rows.shape[1] > 3:
        bad |= known[:, 3] < 0
    return float(bad.mean()) <= _TOLERATED


def _repeats(sample: np.ndarray, columns: int, fewer: int) -> bool:
    """Return whether a row of `columns` may be several points of `fewer` columns."""
    if columns == 2 * fewer:
        return _are_points_twice(sample.reshape(-1, columns))
    return columns != fewer and columns % fewer == 0


def _are_points_twice(rows: np.ndarray) -> bool:
    """Return whether both halves of the rows look like points.

    The columns of the second half are no coordinates if one of them contains only integers, such as
    ring numbers, or if none is ever negative, but not so in the first half.
    """
    half = rows.shape[1] // 2
    first, second = rows[:, :3], rows[:, half : half + 3]
    whole = (_are_integers(second) & ~_are_integers(first)).any()
    positive = bool((second >= 0).all() and not (first >= 0).all())
    return not (whole or positive)


def _are_integers(table: np.ndarray) -> np.ndarray:
    """Return for each column whether it contains only integers."""
    whole: np.ndarray = (table == np.rint(table)).all(axis=0)
    return whole
