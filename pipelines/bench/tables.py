"""The tables of a bench, from the results of its finished cells."""

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from curate.evaluation.comparison import (
    PairedDifference,
    Spread,
    known_mean,
    paired_difference,
    spread,
)
from curate.evaluation.kitti_rules import DIFFICULTIES
from pipelines.bench.grid import Job
from pipelines.bench.results import JobResult, Levels
from pipelines.bench.truth import BENCH_METHODS

BASELINE = "baseline"
TEACHER = "teacher"
NAMES = {"3d": "3D AP", "bev": "BEV AP", "recall": "recall, 3D"}
# The tables of each ratio: IoU thresholds and figure.
PER_RATIO = (
    ("kitti", "3d"), ("kitti", "bev"), ("kitti", "recall"), ("loose", "3d"), ("loose", "bev"),
)  # fmt: skip
SUMMARISED = (("kitti", "3d"), ("loose", "3d"), ("kitti", "bev"), ("loose", "bev"))


@dataclass(frozen=True)
class Entry:
    """A figure over the seeds, and its gain over the baseline on the same seeds."""

    spread: Spread
    gain: float = math.nan
    digits: int = 1

    @property
    def short(self) -> str:
        """Mean and standard deviation as text."""
        if math.isnan(self.spread.mean):
            return "-"
        std = "" if math.isnan(self.spread.std) else f"±{self.spread.std:.{self.digits}f}"
        return f"{self.spread.mean:.{self.digits}f}{std}"

    @property
    def full(self) -> str:
        """Mean, standard deviation and gain as text."""
        text = self.short.replace("±", " ± ")
        return text if math.isnan(self.gain) else f"{text} ({signed(self.gain)})"


def signed(points: float) -> str:
    """Return a difference with its sign; 0 is +0.0, never -0.0."""
    return f"{round(points, 1) + 0.0:+.1f}"


Value = Entry | PairedDifference | str | int | float


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        title: title of the table.
        columns: column names of one or two lines; the first column contains the row names.
        rows: rows with one value per column.
        overlaps: "kitti" or "loose"; None for a table without IoU thresholds.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Value, ...], ...]
    overlaps: str | None = None


class Finished:
    """The results of finished jobs by method, ratio and seed.

    Args:
        results: the results of all finished jobs.

    Attributes:
        methods: the methods with results, in the order of `BENCH_METHODS`.
        ratios: ratios, ascending.
        seeds: seeds, ascending.
    """

    def __init__(self, results: Sequence[JobResult]) -> None:
        self._by_job = {result.job: result for result in results}
        cells = [job for job in self._by_job if job.method is not None]
        found = {job.method for job in cells if job.method is not None}
        known = [name for name in BENCH_METHODS if name in found]
        self.methods = (*known, *sorted(found - set(known)))
        self.ratios = tuple(sorted({job.ratio for job in cells}))
        self.seeds = tuple(sorted({job.seed for job in cells}))

    @property
    def results(self) -> Collection[JobResult]:
        """The results of all finished jobs."""
        return self._by_job.values()

    def result(self, method: str | None, ratio: float, seed: int) -> JobResult | None:
        """Return the result of a job, None if it is not finished; no method means the teacher."""
        return self._by_job.get(Job(ratio, seed, method))

    @property
    def categories(self) -> tuple[str, ...]:
        """The evaluated categories."""
        return tuple(next(iter(self.results)).recall) if self.results else ()

    @property
    def levels(self) -> tuple[str, ...]:
        """The levels of difficulty."""
        return next(iter(self.results)).difficulties if self.results else DIFFICULTIES

    def without_objects(self, overlaps: str, figure: str) -> list[str]:
        """Return the categories and levels without a figure in every result, such as "Car easy"."""
        tables = [result.table(overlaps, figure) for result in self.results]
        return [
            f"{category} {level}"
            for category in self.categories
            for d, level in enumerate(self.levels)
            if all(table[category][d] is None for table in tables)
        ]

    def values(self, method: str | None, ratio: float, overlaps: str, figure: str) -> np.ndarray:
        """Return (seeds, categories, levels) percent.

        NaN where a cell is not finished or the figure cannot be computed.
        """
        missing: dict[str, Levels] = dict.fromkeys(self.categories, (None,) * len(self.levels))
        results = [self.result(method, ratio, seed) for seed in self.seeds]
        tables = [missing if each is None else each.table(overlaps, figure) for each in results]
        values = [[table[category] for category in self.categories] for table in tables]
        return np.array(values, dtype=np.float64).reshape(len(self.seeds), -1, len(self.levels))

    def means(self, method: str | None, ratio: float, overlaps: str, figure: str) -> np.ndarray:
        """Return (seeds,) means over the categories and levels with a figure."""
        return known_mean(self.values(method, ratio, overlaps, figure), 2)


def all_tables(finished: Finished) -> list[Table]:
    """Return every table: the summary first, then those of each ratio."""
    if not finished.methods:
        return []
    return [
        *(_summary(finished, *what) for what in SUMMARISED),
        *(table for what in SUMMARISED for table in _differences(finished, *what)),
        *(
            table
            for ratio in finished.ratios
            for table in (
                *(_of_ratio(finished, ratio, *what) for what in PER_RATIO),
                *_labels(finished, ratio),
            )
        ),
        _times(finished),
    ]


def _of_ratio(finished: Finished, ratio: float, overlaps: str, figure: str) -> Table:
    """Return a table as in the paper: categories and difficulties, their mean, and the gains."""
    baseline = finished.values(BASELINE, ratio, overlaps, figure)
    rows: list[tuple[Value, ...]] = []
    for method in (None, *finished.methods):
        values = finished.values(method, ratio, overlaps, figure)
        compared = method not in (None, BASELINE)
        columns = (values.reshape(len(values), -1), baseline.reshape(len(values), -1))
        entries = [
            _entry(value, base, compared=compared)
            for value, base in zip(columns[0].T, columns[1].T, strict=True)
        ]
        mean = _entry(known_mean(values, 2), known_mean(baseline, 2), compared=compared)
        gain = "" if math.isnan(mean.gain) else signed(mean.gain)
        rows.append((method or TEACHER, mean.spread.count, *entries, mean, gain))
    names = [
        f"{category[:3]}\n{level.replace('moderate', 'mod.')}"
        for category in finished.categories
        for level in finished.levels
    ]
    overlap = _overlaps(finished, overlaps)
    return Table(
        f"{NAMES[figure]}, IoU {overlap}: {_ratio(finished, ratio)}",
        ("method", "n", *names, "mean", "gain"),
        tuple(rows),
        overlaps,
    )


def _summary(finished: Finished, overlaps: str, figure: str) -> Table:
    """Return the mean over categories and difficulties, by ratio."""
    rows: list[tuple[Value, ...]] = []
    for method in (None, *finished.methods):
        entries = []
        for ratio in finished.ratios:
            values = [finished.means(each, ratio, overlaps, figure) for each in (method, BASELINE)]
            entries.append(_entry(*values, compared=method not in (None, BASELINE)))
        rows.append((method or TEACHER, *entries))
    return Table(
        f"mean {NAMES[figure]}, IoU {_overlaps(finished, overlaps)}, by labeled ratio",
        ("method", *(f"{100 * ratio:g} %" for ratio in finished.ratios)),
        tuple(rows),
        overlaps,
    )


def _differences(finished: Finished, overlaps: str, figure: str) -> Iterator[Table]:
    """Yield the differences of mean AP between methods, paired by seed, with their intervals."""
    means = {
        method: np.array(
            [finished.means(method, ratio, overlaps, figure) for ratio in finished.ratios]
        )
        for method in finished.methods
    }
    rows: list[tuple[Value, ...]] = []
    for better, other in _compared(finished.methods):
        values, base = means[better], means[other]
        pairs = [paired_difference(*of) for of in zip(values, base, strict=True)]
        # The differences of a seed at several ratios are not independent: their mean is one pair.
        pooled = paired_difference(values.mean(axis=0), base.mean(axis=0))
        rows.append((f"{better} - {other}", *pairs, pooled))
    if rows:
        yield Table(
            f"differences of mean {NAMES[figure]}, IoU {_overlaps(finished, overlaps)}, paired by "
            "seed, with their 95 % t intervals",
            ("methods", *(f"{100 * ratio:g} %" for ratio in finished.ratios), "all ratios"),
            tuple(rows),
            overlaps,
        )


def _compared(methods: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs to compare: every method with the baseline, the paper's with the others."""
    pairs = [(method, BASELINE) for method in methods if BASELINE in methods]
    pairs += [
        (paper_method, other)
        for paper_method, excluded in (("pspsl", ()), ("spsl", ("pspsl",)))
        for other in methods
        if paper_method in methods and other not in (*excluded, BASELINE)
    ]
    return [(one, other) for one, other in pairs if one != other]


def _labels(finished: Finished, ratio: float) -> Iterator[Table]:
    """Yield the quality of the labels of the last round, against the simulated ground truth."""
    rows: list[tuple[Value, ...]] = []
    for method in finished.methods:
        results = [finished.result(method, ratio, seed) for seed in finished.seeds]
        last = [result.labels[-1] for result in results if result is not None and result.labels]
        if not last:
            continue
        figures = (
            [each.labels for each in last],
            [each.trusted for each in last],
            [each.precision for each in last],
            [each.recall for each in last],
            [None if each.auroc is None else 100 * each.auroc for each in last],
        )
        digits = (0, 0, 1, 1, 1)
        spreads = [spread(_numbers(values)) for values in figures]
        entries = [Entry(of, digits=d) for of, d in zip(spreads, digits, strict=True)]
        rows.append((method, *entries))
    if rows:
        yield Table(
            f"pseudo-labels of the last round, percent: {_ratio(finished, ratio)}",
            ("method", "labels", "weight > 0", "weighted precision", "weighted recall", "AUROC"),
            tuple(rows),
        )


def _times(finished: Finished) -> Table:
    """Return the times of the jobs that finished in a single run."""
    rows: list[tuple[Value, ...]] = []
    for method in (None, *finished.methods):
        minutes = [
            result.seconds / 60
            for result in finished.results
            if result.method == method and not result.resumed
        ]
        rows.append((method or TEACHER, len(minutes), Entry(spread(_numbers(minutes)))))
    return Table(
        "minutes per cell, one process with one thread; the teacher is shared by all methods",
        ("method", "cells", "minutes"),
        tuple(rows),
    )


def _entry(values: np.ndarray, baseline: np.ndarray, *, compared: bool) -> Entry:
    """Return the spread over the seeds; the gain uses only seeds that both methods have."""
    gain = spread(values - baseline).mean if compared else math.nan
    return Entry(spread(values), gain)


def _numbers(values: Sequence[float | None]) -> np.ndarray:
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


def _overlaps(finished: Finished, overlaps: str) -> str:
    if not finished.results:
        return "-"
    thresholds = next(iter(finished.results)).thresholds[overlaps]
    return "/".join(f"{thresholds[category]:g}" for category in finished.categories)


def _ratio(finished: Finished, ratio: float) -> str:
    """Return a ratio with its numbers of frames, which are the same for every seed and method."""
    frames = next(result.frames for result in finished.results if result.ratio == ratio)
    train = frames["labeled"] + frames["unlabeled"]
    return f"{100 * ratio:g} % labeled ({frames['labeled']} of {train} frames)"
