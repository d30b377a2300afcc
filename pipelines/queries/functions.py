"""SQL functions that SQLite lacks: median, quantile, corr, stddev and iou_bev.

Nulls are skipped, as by SQLite's own aggregates; with too few values the result is null. The
results equal those of numpy.median, numpy.quantile, numpy.corrcoef, numpy.std with ddof=1, and of
`curate.geometry.overlap.bev_iou`. Nothing heavy is imported before a function is called.
"""

import math
import sqlite3
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from curate.errors import CurateError

MOST_VALUES = 1 << 25
"""Maximum number of values of one median or quantile: 256 MiB of memory."""
_BOX = ("x", "y", "length", "width", "yaw")


@dataclass(frozen=True)
class SqlFunction:
    """An SQL function.

    Attributes:
        name: its name.
        arguments: names of its arguments.
        meaning: what it returns.
        postgresql: the equivalent on a PostgreSQL server.
    """

    name: str
    arguments: str
    meaning: str
    postgresql: str


FUNCTIONS = (
    SqlFunction(
        "median",
        "x",
        "Median of x.",
        "`percentile_cont(0.5) WITHIN GROUP (ORDER BY x)`",
    ),
    SqlFunction(
        "quantile",
        "x, q",
        "Quantile q of x, interpolated linearly; q from 0 to 1.",
        "`percentile_cont(q) WITHIN GROUP (ORDER BY x)`",
    ),
    SqlFunction("corr", "x, y", "Pearson correlation of x and y.", "built in"),
    SqlFunction("stddev", "x", "Standard deviation of x, divided by n - 1.", "built in"),
    SqlFunction(
        "iou_bev",
        ", ".join(f"{name}{i}" for i in (1, 2) for name in _BOX),
        "BEV IoU of two boxes, 0 to 1; metres and radians.",
        "not available: export the labels and query the file",
    ),
)


class ArgumentError(CurateError):
    """An SQL function got an invalid argument."""


def register_functions(connection: sqlite3.Connection) -> list[str]:
    """Add the functions to a connection.

    Returns:
        A list that will contain the message of the last call with invalid arguments. Such a call
        returns null, as SQLite's own mathematical functions do.
    """
    errors: list[str] = []

    def aggregate(name: str, count: int, kind: Callable[[], Any]) -> None:
        connection.create_aggregate(name, count, lambda: _Reporting(kind(), errors))

    aggregate("median", 1, lambda: _Quantile("median", 0.5))
    aggregate("quantile", 2, lambda: _Quantile("quantile"))
    aggregate("corr", 2, _Correlation)
    aggregate("stddev", 1, _Deviation)

    def iou_bev(*numbers: Any) -> float | None:
        try:
            return _iou_bev(*numbers)
        except ArgumentError as error:
            errors[:] = [str(error)]
            return None

    connection.create_function("iou_bev", 2 * len(_BOX), iou_bev, deterministic=True)
    return errors


class _Reporting:
    """An aggregate that reports an invalid argument and then returns null."""

    def __init__(self, aggregate: Any, errors: list[str]) -> None:
        self._aggregate, self._errors = aggregate, errors

    def step(self, *arguments: Any) -> None:
        """Add a row."""
        if self._aggregate is None:
            return
        try:
            self._aggregate.step(*arguments)
        except ArgumentError as error:
            self._errors[:] = [str(error)]
            self._aggregate = None

    def finalize(self) -> Any:
        """Return the result."""
        return self._aggregate.finalize() if self._aggregate else None


class _Quantile:
    """Collects the values as doubles; numpy computes the quantile."""

    def __init__(self, name: str, q: float | None = None) -> None:
        self._name, self._q = name, q
        self._fixed = q is not None
        self._values = array("d")

    def step(self, x: Any, q: Any = None) -> None:
        """Add a row."""
        if x is None:
            return
        if not self._fixed:
            q = _number(self._name, q)
            if not 0 <= q <= 1:
                raise ArgumentError(f"{self._name}: q is {q:g}, but must be between 0 and 1")
            if self._q not in (None, q):
                raise ArgumentError(f"{self._name}: q must be the same in all rows of a group")
            self._q = q
        if len(self._values) == MOST_VALUES:
            raise ArgumentError(f"{self._name}: more than {MOST_VALUES} values; select fewer rows")
        self._values.append(_number(self._name, x))

    def finalize(self) -> float | None:
        """Return the quantile."""
        if not self._values:
            return None
        import numpy as np

        return float(np.quantile(np.frombuffer(self._values), self._q or 0.0))


class _Deviation:
    """Updates the mean and the sum of squared differences with each value (Welford)."""

    def __init__(self) -> None:
        self._count, self._mean, self._squares = 0, 0.0, 0.0

    def step(self, x: Any) -> None:
        """Add a row."""
        if x is None:
            return
        value = _number("stddev", x)
        self._count += 1
        delta = value - self._mean
        self._mean += delta / self._count
        self._squares += delta * (value - self._mean)

    def finalize(self) -> float | None:
        """Return the standard deviation."""
        return math.sqrt(self._squares / (self._count - 1)) if self._count > 1 else None


class _Correlation:
    """Updates the means and the sums of squares and products with each pair (Welford)."""

    def __init__(self) -> None:
        self._count, self._mean_x, self._mean_y = 0, 0.0, 0.0
        self._xx, self._yy, self._xy = 0.0, 0.0, 0.0

    def step(self, x: Any, y: Any) -> None:
        """Add a row."""
        if x is None or y is None:
            return
        x, y = _number("corr", x), _number("corr", y)
        self._count += 1
        delta_x, delta_y = x - self._mean_x, y - self._mean_y
        self._mean_x += delta_x / self._count
        self._mean_y += delta_y / self._count
        self._xx += delta_x * (x - self._mean_x)
        self._yy += delta_y * (y - self._mean_y)
        self._xy += delta_x * (y - self._mean_y)

    def finalize(self) -> float | None:
        """Return the correlation; None if x or y is constant."""
        if not (self._xx > 0 and self._yy > 0):
            return None
        return max(-1.0, min(1.0, self._xy / math.sqrt(self._xx) / math.sqrt(self._yy)))


def _iou_bev(*numbers: Any) -> float | None:
    if None in numbers:
        return None
    import numpy as np

    from curate.geometry.overlap import bev_iou

    values = [_number("iou_bev", value) for value in numbers]
    boxes = np.array([[x, y, 0.0, length, width, 1.0, yaw] for x, y, length, width, yaw in (
        values[: len(_BOX)], values[len(_BOX) :],
    )])  # fmt: skip
    return float(bev_iou(boxes[:1], boxes[1:])[0, 0])


def _number(function: str, value: Any) -> float:
    if not isinstance(value, int | float):
        raise ArgumentError(f"{function}: {str(value)[:40]!r} is not a number")
    return float(value)
