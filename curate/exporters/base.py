"""The interface of exporters, and the label set that they write."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from curate.errors import DataError, LeakageError
from curate.exporters.columns import WEIGHTED_LABELS
from curate.frames import Frame
from curate.priors.base import Column
from curate.weighting.base import ZeroWeight

BOX_COLUMNS = ("x", "y", "z", "length", "width", "height", "yaw")
WEIGHTED_LABEL_COLUMNS = tuple(column.name for column in WEIGHTED_LABELS)
GROUND_TRUTH_COLUMNS = ("frame", "k", "category", *BOX_COLUMNS, "truncated", "occluded")

# How many frames an error message lists.
_LISTED_FRAMES = 5

Block = Mapping[str, Sequence[Any] | np.ndarray]
"""Rows as named columns of the same length; None, or NaN in an array, means unknown."""
Columns = Mapping[str, list[Any]]
"""A block as plain Python values."""


@dataclass(frozen=True, eq=False)
class LabelRows(Mapping[str, list[Any]]):
    """A block of labels as rows of plain Python values, which can also be read by column.

    A database gives rows, and tables of labels are written in rows; a label set with such blocks
    is exported several times as fast as one with columns.

    Attributes:
        names: the columns.
        rows: one tuple per label, with a value per column; None means unknown.
    """

    names: tuple[str, ...]
    rows: Sequence[tuple[Any, ...]]

    def __getitem__(self, name: str) -> list[Any]:
        """Return a column."""
        return list(map(itemgetter(self._places[name]), self.rows))

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def _places(self) -> Mapping[str, int]:
        return {name: place for place, name in enumerate(self.names)}


@dataclass(frozen=True)
class LabelFileDescription:
    """The origin of the labels: data set, round and policy.

    Attributes:
        dataset: name of the data set, as in the registry.
        root: folder that the paths of the frames are relative to.
        categories: the categories to learn, in the detector's order.
        round: the round that made the labels.
        policy: the policy that weighted them.
        code_version: the version of curate.
        zero_weight: the meaning of weight 0, see `ZeroWeight`. A label that a person rejected is
            always background.
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
    """A frame to learn from, with the paths of its files relative to the root of the data set.

    The image is that of the first camera, and None if the data set has no images.
    """

    frame: str
    split: str
    points: str
    image: str | None
    calibration: str
    further_images: tuple[str, ...] = ()

    @property
    def images(self) -> tuple[str, ...]:
        """The paths of the images of all cameras."""
        return (*((self.image,) if self.image else ()), *self.further_images)


@dataclass(frozen=True)
class LabelSet:
    """Everything that a student may learn from: X_l with ground truth, X_u with weighted labels.

    A labeled frame without objects is included, because it teaches background. An unlabeled frame
    without labels is not included, because no weight says how reliable its emptiness is.

    Attributes:
        description: see `LabelFileDescription`.
        frames: the labeled and unlabeled frames, in their order.
        ground_truth: the columns `GROUND_TRUTH_COLUMNS` for the objects of labeled frames.
        labels: blocks with the columns `columns` for the labels of unlabeled frames, sorted by
            frame and k; a frame may continue in the next block. Each export iterates over them
            once.
        read: returns calibration and image size of a frame, for formats in the camera frame.
        read_points: like `read`, with the points, for formats that contain the points of objects.
        columns: columns of the labels: the core columns first, then further evidence.

    Raises:
        LeakageError: if there is ground truth of a frame that is not labeled, or a frame of another
            split.
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
                    f"frame {each.frame} is in the split {each.split!r}; export labeled and "
                    "unlabeled frames only"
                )
        leaked = set(self.ground_truth["frame"]) - self._of_split("labeled")
        if leaked:
            raise LeakageError(
                f"the labels to export contain ground truth of frames outside the labeled split: "
                f"{named(leaked)}; export ground truth of labeled frames only"
            )

    @property
    def column_names(self) -> tuple[str, ...]:
        """The names of the label columns."""
        return tuple(column.name for column in self.columns)

    def truth(self) -> LabelRows:
        """Return the ground truth as plain Python values."""
        return _as_rows(self.ground_truth, GROUND_TRUTH_COLUMNS)

    def blocks(self) -> Iterator[LabelRows]:
        """Iterate over the blocks of labels and check each of them.

        Raises:
            DataError: if a weight is not a number in [0, 1], a label belongs to a frame outside the
                unlabeled split, or a block has other columns.
        """
        unlabeled, names = self._of_split("unlabeled"), self.column_names
        for labels in self.labels:
            block = _as_rows(labels, names)
            _check_weights(block)
            unexpected = set(block["frame"]) - unlabeled
            if unexpected:
                raise DataError(
                    f"labels of frames outside the unlabeled split: {named(unexpected)}; "
                    "export labels of unlabeled frames only"
                )
            yield block

    def _of_split(self, split: str) -> set[str]:
        return {each.frame for each in self.frames if each.split == split}


class Exporter(Protocol):
    """Writes a label set in one format.

    An export is atomic: if it fails or is killed, the previous export stays as it was. It only
    replaces a previous export; if anything else is at the path, it raises `ConfigError`.

    A trainer that does not read weights must never learn a label of weight 0 as an object. The
    format therefore depends on `LabelFileDescription.zero_weight`: labels to ignore are written in
    a form that the format's readers ignore; background labels are written where its readers do not
    look, or are omitted.
    """

    name: ClassVar[str]
    suffix: ClassVar[str]
    """The suffix of the file, such as ".sqlite"; "" for a format that is a folder."""

    def write(self, path: Path, labels: LabelSet) -> int:
        """Write the file or folder `path` and return how many labels it contains.

        Raises:
            ConfigError: if something other than a previous export is at the path.
            DataError: if a label is invalid, for example its weight is not in [0, 1].
        """
        ...


@dataclass(frozen=True)
class DataToExport:
    """What is known of a data set before any work.

    Attributes:
        frame: any frame, without points.
        images: the paths of its images.
        categories: the categories to learn.
    """

    frame: Frame
    images: tuple[Path, ...]
    categories: tuple[str, ...]


@runtime_checkable
class Selective(Protocol):
    """An exporter to a format that cannot hold the labels of every data set."""

    def check_data(self, data: DataToExport) -> None:
        """Check before any work whether labels of a data set can be written.

        Raises:
            ConfigError: if they cannot.
        """
        ...


def _as_rows(block: Block, names: tuple[str, ...]) -> LabelRows:
    """Return the rows with the columns in the order of `names`."""
    if isinstance(block, LabelRows) and block.names == names:
        return block
    if set(block) != set(names) or len({len(values) for values in block.values()}) != 1:
        raise DataError(
            f"a block of labels has the columns {', '.join(block)}; it needs {', '.join(names)}, "
            "all of the same length"
        )
    return LabelRows(names, list(zip(*(_as_list(block[name]) for name in names), strict=True)))


def _as_list(values: Sequence[Any] | np.ndarray) -> list[Any]:
    if not isinstance(values, np.ndarray):
        return list(values)
    plain: list[Any] = values.tolist()
    return [None if value != value else value for value in plain]  # noqa: PLR0124 - only NaN is


def _check_weights(block: LabelRows) -> None:
    weights = block["weight"]
    if set(map(type, weights)) <= {float, int}:
        values = np.array(weights, dtype=np.float64)
        if ((values >= 0) & (values <= 1)).all():
            return
    for row, weight in enumerate(weights):
        if not (isinstance(weight, int | float) and 0 <= weight <= 1):
            raise bad_weight(block["frame"][row], block["k"][row], weight)


def bad_weight(frame: str, k: int, weight: object) -> DataError:
    """Return the error for a label with an invalid weight."""
    return DataError(
        f"frame {frame}: label {k} has weight {weight!r}, expected a number in [0, 1]; curate did "
        "not write it: restore a backup"
    )


def named(frames: Iterable[str]) -> str:
    """Return the first few frames as text, and the number of the others."""
    names = sorted(frames)
    more = f" and {len(names) - _LISTED_FRAMES} more" if len(names) > _LISTED_FRAMES else ""
    return ", ".join(names[:_LISTED_FRAMES]) + more
