"""Passes of a detector over a data set: one over the frames, others over augmented copies."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from curate.datasets.frame_names import FrameNames
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
        sigmoid: whether the scores are logits.
    """

    path: Path
    plain: ResultsByFrame
    augmented: Sequence[tuple[Path, Similarity, ResultsByFrame]]
    sigmoid: bool

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
        plain = read_results(path, kind, options)
        augmented = []
        for number, entry in enumerate(passes, start=1):
            similarity = _similarity(number, entry)
            place = path.parent / entry["path"]
            if not place.exists():
                raise DataError(f"{place}: no such file or folder; see detector.options.passes")
            results = read_results(place, kind, options)
            augmented.append((place, similarity, _spelled_as(plain, results, place)))
        return cls(path, plain, augmented, options.sigmoid)

    @property
    def has_views(self) -> bool:
        """Whether the record contains a pass over augmented copies."""
        return bool(self.augmented)

    def frame_ids(self) -> tuple[str, ...]:
        """Return the frames of the first pass, in sorted order."""
        return tuple(sorted(self.plain))

    def check(self, frame_ids: Iterable[str]) -> None:
        """Read the results of some frames in all passes, to find invalid ones before any work.

        Raises:
            DataError: if a result is malformed, or a score is neither in [0, 1] nor a logit.
        """
        frame_ids = tuple(frame_ids)
        for path, results in (
            (self.path, self.plain),
            *((path, results) for path, _, results in self.augmented),
        ):
            scores = ((name, results[name].scores) for name in frame_ids if name in results)
            check_scores(path, scores, sigmoid=self.sigmoid)

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


def _spelled_as(plain: ResultsByFrame, results: ResultsByFrame, place: Path) -> ResultsByFrame:
    """Return the results of a pass under the frame names of the first one."""
    if results.keys() <= plain.keys():
        return results
    found, _ = FrameNames(plain).match(results, place)
    return {frame: results[name] for name, frame in found.items()}


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
