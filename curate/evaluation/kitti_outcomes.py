"""What became of every single object and detection under KITTI's rules: found, missed, false."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from curate.datasets.kitti.labels import KittiObjects
from curate.detections import Columns
from curate.errors import ConfigError
from curate.evaluation.kitti_ap import check_frames
from curate.evaluation.kitti_matching import (
    METRICS,
    Candidates,
    Contest,
    PooledFrames,
    candidates_by_metric,
    dont_care_shares,
    match_results,
)
from curate.evaluation.kitti_rules import (
    ABSENT,
    DIFFICULTIES,
    IGNORED,
    MIN_OVERLAPS,
    label_states,
    result_states,
)
from curate.shapes import Float, Int, Shaped

TRUE_POSITIVE, FALSE_POSITIVE, FALSE_NEGATIVE, LEFT_OUT = "tp", "fp", "fn", "ignored"


@dataclass(frozen=True)
class Outcomes(Columns):
    """One row per object of a category under evaluation, in the order of category, frame, object.

    A neighbouring category's objects (Van for Car) are rows of that evaluation too, as ignored.

    Attributes:
        categories: (n,) str, the category under evaluation.
        frames: (n,) int64, position of the frame in what was given.
        indices: (n,) int64, position of the object in its frame.
        outcomes: (n,) str: labels "tp", "fn" or "ignored"; detections "tp", "fp" or "ignored".
        matches: (n,) int64, position in the same frame of the detection that found the object, or
            of the object that the detection found; -1 where none.
        overlaps: (n,) float64 overlap with the match, else the greatest with any that took part.
        scores: (n,) float64 of the detection, of the matched one for labels; NaN where none.
    """

    categories: Shaped[np.ndarray, " n"]
    frames: Int[np.ndarray, " n"]
    indices: Int[np.ndarray, " n"]
    outcomes: Shaped[np.ndarray, " n"]
    matches: Int[np.ndarray, " n"]
    overlaps: Float[np.ndarray, " n"]
    scores: Float[np.ndarray, " n"]

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of all parts."""
        return cls(
            *(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls))
        )


def object_outcomes(
    labels: Sequence[KittiObjects],
    results: Sequence[KittiObjects],
    *,
    metric: str = "3d",
    difficulty: str = "hard",
    score_threshold: float = -np.inf,
    min_overlaps: Mapping[str, float] = MIN_OVERLAPS,
) -> tuple[Outcomes, Outcomes]:
    """Outcomes of the labels and of the results.

    Args:
        labels: the objects of each frame.
        results: the detections of each frame, in the same order.
        metric: overlap that decides, "image", "bev" or "3d".
        difficulty: "easy", "moderate" or "hard"; objects beyond it are ignored.
        score_threshold: detections below it do not take part.
        min_overlaps: the categories to evaluate, and the overlap that a detection must exceed.

    Raises:
        ConfigError: if there is no such metric or difficulty.
        DataError: if the numbers of frames differ, or a detection has no score.
    """
    if metric not in METRICS or difficulty not in DIFFICULTIES:
        raise ConfigError(
            f"no metric {metric!r} or no difficulty {difficulty!r}: "
            f"choose of {', '.join(METRICS)} and of {', '.join(DIFFICULTIES)}"
        )
    check_frames(labels, results)
    pooled = PooledFrames.of(labels), PooledFrames.of(results)
    candidates = candidates_by_metric(*pooled)[metric]
    shares = dont_care_shares(*pooled) * (metric == "image")
    level = DIFFICULTIES.index(difficulty)
    pairs = []
    for category, min_overlap in min_overlaps.items():
        contest = Contest(
            label_states(pooled[0].objects, category, level),
            result_states(pooled[1].objects, category, level),
            pooled[1].objects.scores,
            min_overlap,
        )
        contest.result_states[contest.scores < score_threshold] = ABSENT
        pairs.append(_outcomes(category, pooled, contest, candidates, shares > min_overlap))
    of_labels, of_results = zip(*pairs, strict=True)
    return Outcomes.joined(of_labels), Outcomes.joined(of_results)


def _outcomes(
    category: str,
    pooled: tuple[PooledFrames, PooledFrames],
    contest: Contest,
    candidates: Candidates,
    in_dont_care: np.ndarray,
) -> tuple[Outcomes, Outcomes]:
    """Outcomes of one category; `in_dont_care` is (results,) bool."""
    finders = match_results(candidates, contest, -np.inf)
    found = _inverse(finders, len(contest.scores))
    of_labels = np.full(len(finders), FALSE_NEGATIVE, dtype="<U7")
    of_labels[finders >= 0] = TRUE_POSITIVE
    of_results = np.full(len(found), FALSE_POSITIVE, dtype="<U7")
    of_results[found >= 0] = TRUE_POSITIVE
    of_labels[_with_ignored(contest.label_states, finders, contest.result_states)] = LEFT_OUT
    of_results[_with_ignored(contest.result_states, found, contest.label_states)] = LEFT_OUT
    of_results[in_dont_care & (found < 0)] = LEFT_OUT
    overlaps = _overlaps(candidates, contest, finders)
    scores = np.where(finders >= 0, np.append(contest.scores, np.nan)[finders], np.nan)
    label_rows = np.flatnonzero(contest.label_states != ABSENT)
    takes_part = contest.result_states != ABSENT
    result_rows = np.flatnonzero(takes_part & (pooled[1].objects.categories == category))
    return (
        _rows(category, pooled, label_rows, (of_labels, finders, overlaps[0], scores)),
        _rows(
            category, pooled[::-1], result_rows, (of_results, found, overlaps[1], contest.scores)
        ),
    )


def _rows(
    category: str,
    pooled: tuple[PooledFrames, PooledFrames],
    rows: np.ndarray,
    columns: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> Outcomes:
    """`Outcomes` of some rows.

    Args:
        category: under evaluation.
        pooled: the objects that have the outcomes, and the others.
        rows: (n,) which of the objects.
        columns: outcomes, matches (as rows of the others), overlaps, scores of all objects.
    """
    outcomes, matches, overlaps, scores = (column[rows] for column in columns)
    own_starts, other_starts = pooled[0].starts, pooled[1].starts
    frames = np.searchsorted(own_starts, rows, side="right") - 1
    return Outcomes(
        np.full(len(rows), category),
        frames,
        rows - own_starts[frames],
        outcomes,
        np.where(matches >= 0, matches - other_starts[frames], -1),
        overlaps,
        scores,
    )


def _inverse(matches: np.ndarray, count: int) -> np.ndarray:
    """Return (count,) row whose match each is, -1 where none."""
    inverse = np.full(count, -1)
    rows = np.flatnonzero(matches >= 0)
    inverse[matches[rows]] = rows
    return inverse


def _with_ignored(
    states: np.ndarray, matches: np.ndarray, states_of_others: np.ndarray
) -> np.ndarray:
    """Return (n,) bool, whether a row or its match is ignored."""
    matched = matches >= 0
    ignored: np.ndarray = states == IGNORED
    ignored[matched] |= states_of_others[matches[matched]] == IGNORED
    return ignored


def _overlaps(
    candidates: Candidates, contest: Contest, finders: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (labels,) and (results,) overlap with the match, else the greatest that took part."""
    rows = np.repeat(np.arange(len(finders)), np.diff(candidates.starts))
    takes_part = contest.label_states[rows] != ABSENT
    takes_part &= contest.result_states[candidates.results] != ABSENT
    rows, columns = rows[takes_part], candidates.results[takes_part]
    overlaps = candidates.overlaps[takes_part]
    of_labels, of_results = np.zeros(len(finders)), np.zeros(len(contest.scores))
    np.maximum.at(of_labels, rows, overlaps)
    np.maximum.at(of_results, columns, overlaps)
    is_match = finders[rows] == columns
    of_labels[rows[is_match]] = overlaps[is_match]
    of_results[columns[is_match]] = overlaps[is_match]
    return of_labels, of_results
