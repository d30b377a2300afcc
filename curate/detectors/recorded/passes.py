"""Passes of a detector over a data set: one over the frames, others over augmented copies."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from curate.detectors.recorded.formats import read_results
from curate.detectors.recorded.results import (
    ReadOptions,
    RecordedResult,
    ResultsByFrame,
    check_scores,
)
from curate.errors import ConfigError, DataError
from curate.geometry.similarity import Similarity

_PARAMETERS = ("flip_y", "rotation_rad", "scale")


@dataclass(frozen=True)
class PassesRecord:
    """The results of each frame x, and of A(x) with one A per further pass.

    Attributes:
        path: file or folder of the first pass.
        plain: results of the first pass.
        augmented: path, A and results of each further pass, in A's frame of reference.
    """

    path: Path
    plain: ResultsByFrame
    augmented: Sequence[tuple[Path, Similarity, ResultsByFrame]]

    @classmethod
    def read(
        cls, path: Path, kind: str, options: ReadOptions, passes: Sequence[Mapping[str, Any]]
    ) -> "PassesRecord":
        """Return all passes; they are in the same format.

        Args:
            path: file or folder of the first pass.
            kind: the format, see `formats`.
            options: see `ReadOptions`.
            passes: `path` of each further pass (relative to the folder of the first), and its A as
                one or more of `flip_y`, `rotation_rad` and `scale`.

        Raises:
            ConfigError: if a pass has other keys, or A is missing or the identity.
            DataError: if a file is missing or malformed.
        """
        augmented = []
        for number, entry in enumerate(passes, start=1):
            similarity = _similarity(number, entry)
            place = path.parent / entry["path"]
            if not place.exists():
                raise DataError(f"{place}: no such file or folder; see detector.options.passes")
            augmented.append((place, similarity, read_results(place, kind, options)))
        plain = read_results(path, kind, options)
        for place, results in ((path, plain), *((place, found) for place, _, found in augmented)):
            check_scores(place, results, sigmoid=options.sigmoid)
        return cls(path, plain, augmented)

    @property
    def has_views(self) -> bool:
        """Whether the record contains a pass over augmented copies."""
        return bool(self.augmented)

    def frame_ids(self) -> tuple[str, ...]:
        """Return the frames of the first pass, in sorted order."""
        return tuple(sorted(self.plain))

    def result(self, frame_id: str) -> RecordedResult:
        """Return the result of the first pass.

        Raises:
            DataError: if the pass has no such frame.
        """
        return _frame_result(self.plain, frame_id, self.path)

    def views(self, frame_id: str) -> Sequence[tuple[Similarity, RecordedResult]]:
        """Return A and the result of each further pass.

        Raises:
            DataError: if a pass has no such frame.
        """
        return [
            (similarity, _frame_result(results, frame_id, path))
            for path, similarity, results in self.augmented
        ]


def _frame_result(results: ResultsByFrame, frame_id: str, path: Path) -> RecordedResult:
    if frame_id not in results:
        raise DataError(f"no recorded detections for frame {frame_id} in {path}")
    return results[frame_id]


def _similarity(number: int, entry: Mapping[str, Any]) -> Similarity:
    """Return A of a pass."""
    place = f"detector.options.passes: pass {number}"
    unknown = sorted(set(entry) - {"path", *_PARAMETERS})
    if unknown or "path" not in entry:
        raise ConfigError(f"{place}: takes path, {', '.join(_PARAMETERS)}, not {list(entry)}")
    try:
        similarity = Similarity(
            bool(entry.get("flip_y", False)),
            float(entry.get("rotation_rad", 0.0)),
            float(entry.get("scale", 1.0)),
        )
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{place}: {error}") from None
    if similarity == Similarity():
        raise ConfigError(
            f"{place}: state how the points were transformed, with at least one of "
            f"{', '.join(_PARAMETERS)}; a second pass over the same points does not measure "
            "consistency"
        )
    return similarity
