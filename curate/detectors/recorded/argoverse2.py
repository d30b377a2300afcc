"""Detections of Argoverse 2's evaluation in a Feather file.

Source: Argoverse 2's user guide of 3D detection (argoverse.github.io) and its code (av2-api). A row
is a box: tx_m, ty_m, tz_m of its centre, length_m, width_m, height_m, rotation qw, qx, qy, qz, score,
log_id, timestamp_ns, category, in the frame of the ego vehicle. The sweeps of Argoverse 2 are stored
in the same frame, so the data set's points are expected in it. Other columns are ignored.

A log and a time become the name of a frame by a pattern, such as "{log_id}_{timestamp_ns}".
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from curate.detections import Detections
from curate.detectors.recorded.arrow_groups import ArrowGroups, Run
from curate.detectors.recorded.results import ReadOptions, as_detections
from curate.detectors.recorded.rotations import check_rotations
from curate.errors import ConfigError
from curate.geometry.poses import boxes_in_frame

_CENTRE, _SIZE = ("tx_m", "ty_m", "tz_m"), ("length_m", "width_m", "height_m")
_ROTATION = ("qw", "qx", "qy", "qz")
_FRAME = ("log_id", "timestamp_ns")
_TEXTS = (*_FRAME, "category")
_COLUMNS = (*_TEXTS, "score", *_CENTRE, *_SIZE, *_ROTATION)
PATTERNS = ("{log_id}_{timestamp_ns}", "{timestamp_ns}")
"""Patterns that are tried if none is declared; the data set's frames decide."""


class Argoverse2Results(Mapping[str, Detections]):
    """The detections of each frame, each read on access: an invalid box affects only its frame.

    Args:
        path: the .feather file.
        options: `frame_name` is the pattern, and `frame_ids` are the data set's frames.

    Raises:
        ConfigError: if pyarrow is not installed, or the pattern is invalid or does not decide.
        DataError: if the file is missing or damaged, or a column is missing or of a wrong type.
    """

    def __init__(self, path: Path, options: ReadOptions) -> None:
        self._groups = ArrowGroups.of(path, _TEXTS, _required)
        runs = self._groups.runs(_FRAME)
        pattern = options.frame_name or _find_pattern(path, runs, options.frame_ids)
        self._runs: dict[str, Sequence[Run]] = {}
        for (log_id, time), of_frame in runs.items():
            name = _name(pattern, log_id, time)
            if name in self._runs:
                raise ConfigError(
                    f"{path}: two logs have a frame {name}; add {{log_id}} to "
                    "detector.options.frame_name"
                )
            self._runs[name] = of_frame

    def __getitem__(self, frame_id: str) -> Detections:
        """Return the detections of a frame.

        Raises:
            DataError: if they are malformed.
        """
        columns = self._groups.rows(self._runs[frame_id])
        place = f"{self._groups.path}: frame {frame_id}"
        centres, sizes, rotations = (
            np.column_stack([columns[name] for name in names])
            for names in (_CENTRE, _SIZE, _ROTATION)
        )
        check_rotations(place, rotations)
        boxes = boxes_in_frame(centres, sizes, rotations, np.eye(4))
        return as_detections(place, boxes, columns["score"], columns["category"])

    def __iter__(self) -> Iterator[str]:
        return iter(self._runs)

    def __len__(self) -> int:
        return len(self._runs)


def _required(_names: Sequence[str]) -> Sequence[str]:
    return _COLUMNS


def _find_pattern(
    path: Path, frames: Collection[tuple[str, ...]], frame_ids: Collection[str]
) -> str:
    """Return the pattern that names a frame of the data set; the first if none does."""
    existing = set(frame_ids)
    fitting = [
        pattern
        for pattern in PATTERNS
        if any(_name(pattern, log_id, time) in existing for log_id, time in frames)
    ]
    if len(fitting) > 1:
        raise ConfigError(
            f"{path}: frames of the data set are named like {' and like '.join(fitting)}; set "
            "detector.options.frame_name to one of them"
        )
    return (*fitting, PATTERNS[0])[0]


def _name(pattern: str, log_id: str, time: str) -> str:
    """Return the name of a frame."""
    try:
        return pattern.format(log_id=log_id, timestamp_ns=time)
    except (AttributeError, LookupError, ValueError):
        raise ConfigError(
            f"detector.options.frame_name {pattern!r}: use {{log_id}} and {{timestamp_ns}}, as in "
            f"{PATTERNS[0]!r}"
        ) from None


def check_frame_name(pattern: str | None) -> None:
    """Raise ConfigError if a pattern is invalid or is the same for all frames of a log."""
    if pattern is None:
        return
    if _name(pattern, "a", "1") == _name(pattern, "a", "2"):
        raise ConfigError(f"detector.options.frame_name {pattern!r}: must contain {{timestamp_ns}}")
