"""Track evidence: whether an object is also detected before and after, and how consistently.

Clutter appears in single frames, an object in many. The labels of a sequence are linked to tracks,
per category (see `curate.tracking`), and each label gets figures of its track. They are features of
the policy `learned`, which is why scores are given as log-odds. They are not a prior: as a factor
of rho they make the weights worse (see docs/evidence.md).
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from curate.detections import Detections
from curate.errors import ConfigError, DataError
from curate.priors.base import Column, Evidence, SequenceFrame, SequenceSource
from curate.ranges import AboveZero
from curate.shapes import Float, Int
from curate.tracking import MAX_GAP_S, Sightings, track_numbers

_MIN_SCORE = 1e-4  # lower scores, and those above 1 minus it, count as this one
_NUMBER = re.compile(r"([0-9]+)$")


@dataclass(frozen=True)
class Tracks(SequenceSource):
    """Figures of each label's track.

    Attributes:
        rate_hz: frames per second of data sets without timestamps; the time of a frame then follows
            from the number at the end of its name.
    """

    rate_hz: AboveZero = 10.0
    name: ClassVar[str] = "tracks"
    columns: ClassVar[tuple[Column, ...]] = (
        Column("track_length", "int32", "1", "labels of the label's track, itself included"),
        Column("track_score", "float64", "1", "mean of ln(s / (1 - s)) over the track's scores s"),
        Column("track_max_score", "float64", "1", "ln(s / (1 - s)) of the track's highest score s"),
        Column("track_hits", "int32", "1", "other frames within 1 s with a label of the track"),
        Column("track_misses", "int32", "1", "frames within 1 s without one"),
        Column(
            "track_size_deviation",
            "float64",
            "1",
            "sum over length, width, height of |ln(size / geometric mean of the track)|",
        ),
    )

    def __post_init__(self) -> None:
        """Raise ConfigError if the rate is not a positive number."""
        if not (np.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise ConfigError(
                f"evidence source tracks: rate_hz must be above 0, not {self.rate_hz}"
            )

    def check_frame(self, frame_id: str, time_s: float | None) -> None:
        """Raise DataError if the time of a frame is unknown."""
        if time_s is None:
            frame_number(frame_id)

    def score_sequence(self, frames: Sequence[SequenceFrame]) -> Sequence[Evidence]:
        """Return the figures of each frame's labels; the frames may be in any order.

        Raises:
            DataError: if the time of a frame is unknown, or only some frames have a pose.
        """
        times = self._times(frames)
        order = np.argsort(times, kind="stable")
        ranks = np.argsort(order)
        positions, fixed = _positions(frames)
        counts = [len(frame.detections) for frame in frames]
        labels = _joined([frame.detections for frame in frames])
        steps = np.repeat(ranks, counts).astype(np.int64)
        tracks, started = np.zeros(len(labels), dtype=np.int64), 0
        for category in np.unique(labels.categories):
            k = np.flatnonzero(labels.categories == category)
            found = track_numbers(
                Sightings(steps[k], positions[k], labels.boxes[k, 3], times[order], fixed)
            )
            tracks[k] = started + found
            started += int(found.max()) + 1
        figures = _figures(labels, tracks, steps, times[order])
        bounds = np.cumsum([0, *counts])
        return [
            {name: values[bounds[i] : bounds[i + 1]] for name, values in figures.items()}
            for i in range(len(frames))
        ]

    def describe(self, row: Mapping[str, Any]) -> str:
        """Return a line that explains the stored columns of one label, formatted for reading."""
        return (
            f"track of {row['track_length']} labels with log-odds of scores {row['track_score']} "
            f"in the mean and {row['track_max_score']} at most; within 1 s {row['track_hits']} "
            f"frames with it, {row['track_misses']} without; size deviation "
            f"{row['track_size_deviation']}"
        )

    def _times(self, frames: Sequence[SequenceFrame]) -> np.ndarray:
        """Return the (T,) times of the frames in seconds."""
        if len(frames) == 1:
            return np.zeros(1)
        if all(frame.time_s is not None for frame in frames):
            return np.array([frame.time_s for frame in frames], dtype=np.float64)
        return np.array([frame_number(frame.frame_id) for frame in frames]) / self.rate_hz


def frame_number(frame_id: str) -> int:
    """Return the number at the end of a frame's name.

    Raises:
        DataError: if the name does not end with a number.
    """
    found = _NUMBER.search(frame_id)
    if not found:
        raise DataError(
            f"frame {frame_id}: evidence source tracks needs the time of each frame; the data set "
            "has no timestamps, and the name does not end with the number of the frame"
        )
    return int(found[1])


def _positions(frames: Sequence[SequenceFrame]) -> tuple[np.ndarray, bool]:
    """Return the (n, 2) centres of all labels on the ground, and whether they are in the map frame.

    Raises:
        DataError: if only some of the frames have a pose.
    """
    without = [frame.frame_id for frame in frames if frame.pose is None]
    if without and len(without) < len(frames):
        raise DataError(
            f"frame {without[0]}: no pose, but other frames of its sequence have one; add it, or "
            "remove the poses of the sequence"
        )
    parts = [np.zeros((0, 2))]
    for frame in frames:
        centres = frame.detections.boxes[:, :3]
        if frame.pose is not None:
            centres = centres @ frame.pose[:3, :3].T + frame.pose[:3, 3]
        parts.append(centres[:, :2])
    return np.concatenate(parts), not without


def _joined(parts: Sequence[Detections]) -> Detections:
    """Return the labels of all frames."""
    parts = [Detections.empty(), *parts]
    return Detections(
        np.concatenate([part.boxes for part in parts]),
        np.concatenate([part.scores for part in parts]),
        np.concatenate([part.categories for part in parts]),
    )


def _figures(
    labels: Detections,
    tracks: Int[np.ndarray, " n"],
    steps: Int[np.ndarray, " n"],
    times: Float[np.ndarray, " T"],
) -> Evidence:
    """Return the columns of all labels.

    The frames around each label are found by bisection: a label has the key track * (T + 1) + step,
    and the labels of its track in the steps a to b - 1 are those with keys from track * (T + 1) + a
    to below track * (T + 1) + b.
    """
    length = np.bincount(tracks)
    scores = np.clip(labels.scores, _MIN_SCORE, 1 - _MIN_SCORE)
    log_odds = np.log(scores / (1 - scores))
    highest = np.full(len(length), -np.inf)
    np.maximum.at(highest, tracks, log_odds)
    sizes = np.log(labels.boxes[:, 3:6])
    means = np.column_stack([np.bincount(tracks, column) for column in sizes.T]) / length[:, None]
    around = MAX_GAP_S + 1e-6
    first = np.searchsorted(times, times - around)[steps]
    last = np.searchsorted(times, times + around, side="right")[steps]
    base = tracks * (len(times) + 1)
    keys = np.sort(base + steps)
    hits = np.searchsorted(keys, base + last) - np.searchsorted(keys, base + first) - 1
    return {
        "track_length": length[tracks].astype(np.int32),
        "track_score": (np.bincount(tracks, log_odds) / length)[tracks],
        "track_max_score": highest[tracks],
        "track_hits": hits.astype(np.int32),
        "track_misses": (last - first - 1 - hits).astype(np.int32),
        "track_size_deviation": np.abs(sizes - means[tracks]).sum(axis=1),
    }
