"""A detector's passes over a data set: one over the frames, others over augmented copies of all."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from curate.detectors.recorded.formats import read_results
from curate.detectors.recorded.results import Answers, ReadOptions, RecordedResult
from curate.errors import ConfigError, DataError
from curate.geometry.similarity import Similarity

_PARAMETERS = ("flip_y", "rotation_rad", "scale")


@dataclass(frozen=True)
class PassesRecord:
    """The answers for each frame, and for A(x) with an A per pass.

    Attributes:
        path: of the first pass.
        plain: the first pass.
        augmented: path, A and answers of each further pass, in A's frame of reference.
    """

    path: Path
    plain: Answers
    augmented: Sequence[tuple[Path, Similarity, Answers]]

    @classmethod
    def read(
        cls, path: Path, kind: str, reading: ReadOptions, passes: Sequence[Mapping[str, Any]]
    ) -> "PassesRecord":
        """Return all passes, in the same format.

        Args:
            path: file or folder of the first pass.
            kind: of the format, see `formats`.
            reading: see there.
            passes: `path` (relative to the folder of the first), and of `flip_y`, `rotation_rad`
                and `scale` what A does, of each further pass.

        Raises:
            ConfigError: if a pass has other keys, or no A.
            DataError: if a file is missing or malformed.
        """
        augmented = []
        for number, one in enumerate(passes, start=1):
            similarity = _similarity(number, one)
            place = path.parent / one["path"]
            if not place.exists():
                raise DataError(f"{place}: no such record; see detector.options.passes")
            augmented.append((place, similarity, read_results(place, kind, reading)))
        return cls(path, read_results(path, kind, reading), augmented)

    @property
    def has_views(self) -> bool:
        """Whether there is a further pass."""
        return bool(self.augmented)

    def frame_ids(self) -> tuple[str, ...]:
        """Return the frames of the first pass, in sorted order."""
        return tuple(sorted(self.plain))

    def answer(self, frame_id: str) -> RecordedResult:
        """What the first pass found; DataError where it has no such frame."""
        return _of(self.plain, frame_id, self.path)

    def views(self, frame_id: str) -> Sequence[tuple[Similarity, RecordedResult]]:
        """What the further passes found; DataError where one has no such frame."""
        return [
            (similarity, _of(answers, frame_id, path))
            for path, similarity, answers in self.augmented
        ]


def _of(answers: Answers, frame_id: str, path: Path) -> RecordedResult:
    if frame_id not in answers:
        raise DataError(f"no recorded detections for frame {frame_id} in {path}")
    return answers[frame_id]


def _similarity(number: int, one: Mapping[str, Any]) -> Similarity:
    """A of a pass."""
    place = f"detector.options.passes: pass {number}"
    unknown = sorted(set(one) - {"path", *_PARAMETERS})
    if unknown or "path" not in one:
        raise ConfigError(f"{place}: takes path, {', '.join(_PARAMETERS)}, not {list(one)}")
    try:
        similarity = Similarity(
            bool(one.get("flip_y", False)),
            float(one.get("rotation_rad", 0.0)),
            float(one.get("scale", 1.0)),
        )
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{place}: {error}") from None
    if similarity == Similarity():
        raise ConfigError(
            f"{place}: name what was done to the points, at least one of {', '.join(_PARAMETERS)}; "
            "a second look at the same points says nothing of consistency"
        )
    return similarity
