"""What every exporter offers: the labels of a round as files for trainers."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, groupby
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np

from curate.errors import DataError, LeakageError
from curate.exporters.columns import WEIGHTED_LABELS
from curate.frames import Frame
from curate.priors.base import Column
from curate.weighting.base import ZeroWeight

BOX_COLUMNS = ("x", "y", "z", "length", "width", "height", "yaw")
WEIGHTED_LABEL_COLUMNS = tuple(column.name for column in WEIGHTED_LABELS)
GROUND_TRUTH_COLUMNS = ("frame", "k", "category", *BOX_COLUMNS, "truncated", "occluded")

# How many frames an error names.
_NAMED_FRAMES = 5

Block = Mapping[str, Sequence[Any] | np.ndarray]
"""Rows as named columns, all of one length; None, or NaN in an array, is unknown."""
Columns = Mapping[str, list[Any]]
"""A block in plain Python values."""


@dataclass(frozen=True)
class LabelFileDescription:
    """What the labels are about.

    Attributes:
        dataset: name of the data set, as in the registry.
        root: folder that the paths of the frames are relative to.
        categories: the categories to be learned, in the detector's order.
        round: round that made the labels.
        policy: policy that weighted them.
        code_version: of curate.
        zero_weight: what a label of weight 0 is, see `ZeroWeight`. What a person rejected is
            background in any case.
    """

    dataset: str
    root: Path
    categories: tuple[str, ...]
    round: int
    policy: str
    code_version: str
    zero_weight: ZeroWeight = "background"


@dataclass(frozen=True)
class FrameFiles:
    """A frame to learn from, and where its files lie below the root of the data set."""

    frame: str
    split: str
    points: str
    image: str | None
    calibration: str


@dataclass(frozen=True)
class LabelSet:
    """All that a student may learn from: X_l with its ground truth, X_u with weighted labels.

    A labeled frame without objects belongs to it and teaches background. An unlabeled frame without
    labels does not: no weight vouches for its emptiness.

    Attributes:
        description: see `LabelFileDescription`.
        frames: the labeled and unlabeled frames, in their order.
        ground_truth: the columns `GROUND_TRUTH_COLUMNS` of objects of labeled frames.
        labels: blocks with the columns `columns` of labels of unlabeled frames, in the order of
            frames and k; a frame may continue in the next block. Walked anew by each export.
        read: calibration and image size of a frame, for formats in the camera's frame.
        read_points: the same with the frame's points, for formats that carry objects' points.
        columns: of the labels: the core ones first, further evidence behind them.

    Raises:
        LeakageError: ground truth of a frame that is not labeled, or a frame of another split.
    """

    description: LabelFileDescription
    frames: Sequence[FrameFiles]
    ground_truth: Block
    labels: Iterable[Block]
    read: Callable[[str], Frame]
    read_points: Callable[[str], Frame]
    columns: tuple[Column, ...] = WEIGHTED_LABELS

    def __post_init__(self) -> None:
        """Check the splits of the frames and of the ground truth."""
        for each in self.frames:
            if each.split not in ("labeled", "unlabeled"):
                raise LeakageError(
                    f"frame {each.frame} is of split {each.split!r}; export labeled and unlabeled "
                    "frames only"
                )
        leaked = set(self.ground_truth["frame"]) - self._of_split("labeled")
        if leaked:
            raise LeakageError(
                f"labels to export hold ground truth of frames outside the labeled split: "
                f"{named(leaked)}; only labeled frames may bring ground truth into a training"
            )

    @property
    def column_names(self) -> tuple[str, ...]:
        """The names of the columns of the labels."""
        return tuple(column.name for column in self.columns)

    def truth(self) -> Columns:
        """Return the ground truth in plain Python values."""
        return _plain(self.ground_truth, GROUND_TRUTH_COLUMNS)

    def blocks(self) -> Iterator[Columns]:
        """Walk through the labels once, and check them on the way.

        Raises:
            DataError: if a weight is not a number in [0, 1], a label is of a frame outside the
                unlabeled split, or a block has other columns.
        """
        unlabeled = self._of_split("unlabeled")
        for given in self.labels:
            block = _plain(given, self.column_names)
            for place, weight in enumerate(block["weight"]):
                if not (isinstance(weight, int | float) and 0 <= weight <= 1):
                    raise bad_weight(block["frame"][place], block["k"][place], weight)
            strays = set(block["frame"]) - unlabeled
            if strays:
                raise DataError(
                    f"labels of frames outside the unlabeled split: {named(strays)}; export labels "
                    "of unlabeled frames only"
                )
            yield block

    def _of_split(self, split: str) -> set[str]:
        return {each.frame for each in self.frames if each.split == split}


class Exporter(Protocol):
    """Writes a label set in one format.

    An export is whole or not there: what fails or is killed on the way leaves the former one as it
    was. Only former exports are replaced; `ConfigError` where something else is in the place.

    A trainer that reads no weights never takes a label of weight 0 for an object. The format says
    what such labels are, see `LabelFileDescription.zero_weight`: those to ignore are in the form
    that its readers ignore; background ones are where its readers do not look, or left out.
    """

    name: ClassVar[str]
    suffix: ClassVar[str]
    """Of the file, such as ".sqlite"; "" for a format that is a folder."""

    def write(self, path: Path, labels: LabelSet) -> int:
        """Write the file or folder `path`; returns how many labels are in it.

        Raises:
            ConfigError: if something else is in the place.
            DataError: if a label cannot be, such as one with a weight that is not in [0, 1].
        """
        ...


def by_frame(blocks: Iterable[Columns]) -> Iterator[tuple[str, Columns]]:
    """Walk through blocks frame by frame; a frame may continue in the next block."""
    for frame, parts in groupby(chain.from_iterable(map(_parts, blocks)), key=_frame_of):
        own: dict[str, list[Any]] = {}
        for part in parts:
            for name, values in part.items():
                own.setdefault(name, []).extend(values)
        yield frame, own


def _parts(block: Columns) -> Iterator[Columns]:
    """Cut a block where the frame changes."""
    start = 0
    for _, group in groupby(block["frame"]):
        stop = start + sum(1 for _ in group)
        yield {name: values[start:stop] for name, values in block.items()}
        start = stop


def _frame_of(part: Columns) -> str:
    return str(part["frame"][0])


def _plain(block: Block, names: Sequence[str]) -> Columns:
    """Return the columns by name and in order, in plain Python values."""
    if set(block) != set(names) or len({len(values) for values in block.values()}) != 1:
        raise DataError(
            f"a block of labels has the columns {', '.join(block)}; it needs {', '.join(names)}, "
            "all of one length"
        )
    return {name: _as_list(block[name]) for name in names}


def _as_list(values: Sequence[Any] | np.ndarray) -> list[Any]:
    if not isinstance(values, np.ndarray):
        return list(values)
    plain: list[Any] = values.tolist()
    return [None if value != value else value for value in plain]  # noqa: PLR0124 - only NaN is


def bad_weight(frame: str, k: int, weight: object) -> DataError:
    """Return what is wrong with a label with an impossible weight."""
    return DataError(
        f"frame {frame}: label {k} has weight {weight!r}; weights are in [0, 1], something else "
        "has written this one: restore a backup"
    )


def named(frames: Iterable[str]) -> str:
    """Some of the frames, as text."""
    names = sorted(frames)
    more = f" and {len(names) - _NAMED_FRAMES} more" if len(names) > _NAMED_FRAMES else ""
    return ", ".join(names[:_NAMED_FRAMES]) + more
