"""The outcome of each single object and detection by KITTI's rules: tp, fp, fn or ignored."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from curate.datasets.kitti.labels import KittiObjects
from curate.detections import Columns
from curate.errors import ConfigError
from curate.evaluation.difficulties import KITTI, Difficulty
from curate.evaluation.kitti_ap import check_frames
from curate.evaluation.kitti_matching import (
    METRICS,
    Candidates,
    MatchInputs,
    PooledFrames,
    candidates_by_metric,
    dont_care_shares,
    match_results,
)
from curate.evaluation.kitti_rules import ABSENT, IGNORED, MIN_OVERLAPS
from curate.evaluation.kitti_states import Rules
from curate.shapes import Float, Int, Shaped

TRUE_POSITIVE, FALSE_POSITIVE, FALSE_NEGATIVE, LEFT_OUT = "tp", "fp", "fn", "ignored"


@dataclass(frozen=True)
class Outcomes(Columns):
    """One row per object of an evaluated category, sorted by category, frame and object.

    The objects of a neighbour category (Van for Car) have rows too, with the outcome "ignored".

    Attributes:
        categories: (n,) str, the evaluated category.
        frames: (n,) int64, index of the frame in the input.
        indices: (n,) int64, index of the object in its frame.
        outcomes: (n,) str: labels "tp", "fn" or "ignored"; detections "tp", "fp" or "ignored".
        matches: (n,) int64, index in the frame of the matched detection (rows of labels) or of the
            matched object (rows of detections); -1 for none.
        overlaps: (n,) float64 overlap with the match; without a match the greatest overlap with
            any object that takes part.
        scores: (n,) float64 score of the detection, or of the matched one; NaN without a match.
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
        """Concatenate the rows of all parts."""
        return cls(
            *(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls))
        )


def object_outcomes(
    labels: Sequence[KittiObjects],
    results: Sequence[KittiObjects],
    *,
    metric: str = "3d",
    difficulty: Difficulty = KITTI,
    level: str | None = None,
    score_threshold: float = -np.inf,
    min_overlaps: Mapping[str, float] = MIN_OVERLAPS,
    points: Sequence[Int[np.ndarray, " n"]] | None = None,
) -> tuple[Outcomes, Outcomes]:
    """Return the outcomes of the labels and of the results.

    Args:
        labels: the objects of each frame.
        results: the detections of each frame, in the same order.
        metric: the overlap to match by, "image", "bev" or "3d".
        difficulty: the levels of difficulty.
        level: name of the level; objects beyond it are ignored. None for the one with the most
            objects: KITTI's "hard", the last level by points, all distances.
        score_threshold: detections with a lower score take no part.
        min_overlaps: the categories to evaluate, and the overlap that a true positive must exceed.
        points: for levels by points, the LiDAR points in each object of each frame.

    Raises:
        ConfigError: if the metric or the level is unknown.
        DataError: if the numbers of frames differ, or a detection has no score.
    """
    if metric not in METRICS or level not in (None, *difficulty.levels):
        raise ConfigError(
            f"unknown metric {metric!r} or level {level!r}: "
            f"choose a metric from {', '.join(METRICS)}, a level from "
            f"{', '.join(difficulty.levels)}"
        )
    check_frames(labels, results)
    pooled = PooledFrames.of(labels), PooledFrames.of(results)
    candidates = candidates_by_metric(*pooled)[metric]
    shares = dont_care_shares(*pooled) * (metric == "image")
    if level is None:
        difficulty, d = difficulty.whole()
    else:
        d = difficulty.levels.index(level)
    rules = Rules.of(difficulty, min_overlaps, pooled[0].objects, pooled[1].objects, points)
    pairs = []
    for category, min_overlap in min_overlaps.items():
        of_labels, of_results, spared = rules.states(category, d)
        inputs = MatchInputs(of_labels, of_results, pooled[1].objects.scores, min_overlap)
        inputs.result_states[inputs.scores < score_threshold] = ABSENT
        in_dont_care = (shares > min_overlap) | spared
        pairs.append(_outcomes(category, pooled, inputs, candidates, in_dont_care))
    label_rows, result_rows = zip(*pairs, strict=True)
    return Outcomes.joined(label_rows), Outcomes.joined(result_rows)


def _outcomes(
    category: str,
    pooled: tuple[PooledFrames, PooledFrames],
    inputs: MatchInputs,
    candidates: Candidates,
    in_dont_care: np.ndarray,
) -> tuple[Outcomes, Outcomes]:
    """Return the outcomes of one category; `in_dont_care` is (results,) bool."""
    finders = match_results(candidates, inputs, -np.inf)
    found = _inverse(finders, len(inputs.scores))
    of_labels = np.full(len(finders), FALSE_NEGATIVE, dtype="<U7")
    of_labels[finders >= 0] = TRUE_POSITIVE
    of_results = np.full(len(found), FALSE_POSITIVE, dtype="<U7")
    of_results[found >= 0] = TRUE_POSITIVE
    of_labels[_with_ignored(inputs.label_states, finders, inputs.result_states)] = LEFT_OUT
    of_results[_with_ignored(inputs.result_states, found, inputs.label_states)] = LEFT_OUT
    of_results[in_dont_care & (found < 0)] = LEFT_OUT
    overlaps = _overlaps(candidates, inputs, finders)
    scores = np.where(finders >= 0, np.append(inputs.scores, np.nan)[finders], np.nan)
    label_rows = np.flatnonzero(inputs.label_states != ABSENT)
    takes_part = inputs.result_states != ABSENT
    result_rows = np.flatnonzero(takes_part & (pooled[1].objects.categories == category))
    return (
        _rows(category, pooled, label_rows, (of_labels, finders, overlaps[0], scores)),
        _rows(category, pooled[::-1], result_rows, (of_results, found, overlaps[1], inputs.scores)),
    )


def _rows(
    category: str,
    pooled: tuple[PooledFrames, PooledFrames],
    rows: np.ndarray,
    columns: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> Outcomes:
    """Return the `Outcomes` of selected objects.

    Args:
        category: the evaluated category.
        pooled: the objects with these outcomes, and the objects that they are matched with.
        rows: (n,) rows of the selected objects.
        columns: outcomes, matches (rows of the other objects), overlaps and scores of all objects.
    """
    outcomes, matches, overlaps, scores = (column[rows] for column in columns)
    starts, other_starts = pooled[0].starts, pooled[1].starts
    frames = np.searchsorted(starts, rows, side="right") - 1
    return Outcomes(
        np.full(len(rows), category),
        frames,
        rows - starts[frames],
        outcomes,
        np.where(matches >= 0, matches - other_starts[frames], -1),
        overlaps,
        scores,
    )


def _inverse(matches: np.ndarray, count: int) -> np.ndarray:
    """Return (count,) the row that has each index as its match, -1 for none."""
    inverse = np.full(count, -1)
    rows = np.flatnonzero(matches >= 0)
    inverse[matches[rows]] = rows
    return inverse


def _with_ignored(
    states: np.ndarray, matches: np.ndarray, states_of_others: np.ndarray
) -> np.ndarray:
    """Return (n,) bool, True if a row or its match is ignored."""
    matched = matches >= 0
    ignored: np.ndarray = states == IGNORED
    ignored[matched] |= states_of_others[matches[matched]] == IGNORED
    return ignored


def _overlaps(
    candidates: Candidates, inputs: MatchInputs, finders: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (labels,) and (results,) overlap with the match, else the greatest overlap."""
    rows = np.repeat(np.arange(len(finders)), np.diff(candidates.starts))
    takes_part = inputs.label_states[rows] != ABSENT
    takes_part &= inputs.result_states[candidates.results] != ABSENT
    rows, columns = rows[takes_part], candidates.results[takes_part]
    overlaps = candidates.overlaps[takes_part]
    of_labels, of_results = np.zeros(len(finders)), np.zeros(len(inputs.scores))
    np.maximum.at(of_labels, rows, overlaps)
    np.maximum.at(of_results, columns, overlaps)
    is_match = finders[rows] == columns
    of_labels[rows[is_match]] = overlaps[is_match]
    of_results[columns[is_match]] = overlaps[is_match]
    return of_labels, of_results
