"""What every exporter offers: the labels of a round as files for trainers."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import Any, ClassVar, Protocol

from curate.errors import ConfigError, DataError, LeakageError
from curate.exporters.columns import WEIGHTED_LABELS
from curate.frames import Frame

BOX_COLUMNS = ("x", "y", "z", "length", "width", "height", "yaw")
WEIGHTED_LABEL_COLUMNS = tuple(WEIGHTED_LABELS)
GROUND_TRUTH_COLUMNS = ("frame", "k", "category", *BOX_COLUMNS, "truncated", "occluded")
FRAME_COLUMNS = ("frame", "split", "points", "image", "calibration")

# How many frames an error names.
_NAMED_FRAMES = 5

Row = tuple[Any, ...]


class Rows(Protocol):
    """Rows that can be counted and walked through again; they need not be in memory."""

    def __len__(self) -> int:
        """How many there are."""
        ...

    def __iter__(self) -> Iterator[Row]:
        """From the first on."""
        ...


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
    """

    dataset: str
    root: Path
    categories: tuple[str, ...]
    round: int
    policy: str
    code_version: str


@dataclass(frozen=True)
class LabelSet:
    """All that a student may learn from: X_l with its ground truth, X_u with weighted labels.

    A labeled frame without objects belongs to it and teaches background. An unlabeled frame without
    labels does not: no weight vouches for its emptiness.

    Attributes:
        description: see `LabelFileDescription`.
        frames: rows of `FRAME_COLUMNS`; paths relative to the description's root.
        ground_truth: rows of `GROUND_TRUTH_COLUMNS`, of labeled frames.
        labels: rows of `WEIGHTED_LABEL_COLUMNS`, of unlabeled frames, by frame and k.
        read: calibration and image size of a frame, for formats in the camera's frame.
        read_points: the same with the frame's points, for formats that carry objects' points.
        categories: those that ground truth or labels have; not all need be ones to be learned.

    Raises:
        LeakageError: ground truth of a frame that is not labeled, or a frame of another split.
        DataError: labels of a frame that is not unlabeled, or a weight that is no number.
    """

    description: LabelFileDescription
    frames: Sequence[Row]
    ground_truth: Sequence[Row]
    labels: Rows
    read: Callable[[str], Frame]
    read_points: Callable[[str], Frame]
    categories: frozenset[str] = field(init=False)

    def __post_init__(self) -> None:
        """Checks the splits and finds the categories in one walk through the labels."""
        splits = {str(row[0]): str(row[1]) for row in self.frames}
        others = {name for name, split in splits.items() if split not in ("labeled", "unlabeled")}
        leaked = {row[0] for row in self.ground_truth if splits.get(row[0]) != "labeled"}
        if others or leaked:
            raise LeakageError(
                f"labels to export hold {'frames' if others else 'ground truth of frames'} outside "
                f"the labeled split: {named(others or leaked)}; export labeled and unlabeled "
                "frames only, with ground truth of labeled ones"
            )
        columns = ("frame", "category", "weight")
        frame, category, weight = map(WEIGHTED_LABEL_COLUMNS.index, columns)
        found = {(row[frame], row[category], type(row[weight])) for row in self.labels}
        words = {name for name, _, kind in found if not issubclass(kind, Real)}
        if words:  # SQLite keeps text in a column of numbers
            raise DataError(
                f"weights of {named(words)} are no numbers; something else has written them into "
                "the database: restore a backup"
            )
        strays = {name for name, _, _ in found if splits.get(name) != "unlabeled"}
        if strays:
            raise DataError(
                f"labels to export belong to frames outside the unlabeled split: {named(strays)}; "
                "export labels of unlabeled frames only"
            )
        of_truth = GROUND_TRUTH_COLUMNS.index("category")
        categories = {row[of_truth] for row in self.ground_truth} | {name for _, name, _ in found}
        object.__setattr__(self, "categories", frozenset(map(str, categories)))


class Exporter(Protocol):
    """Writes a label set in one format.

    An export is whole or not there: what fails or is killed on the way leaves the former one as it
    was. Only former exports are replaced; `ConfigError` where something else is in the place.
    """

    name: ClassVar[str]
    suffix: ClassVar[str]
    """Of the file, such as ".sqlite"; "" for a format that is a folder."""

    def write(self, path: Path, labels: LabelSet) -> int:
        """Writes the file or folder `path`; returns how many labels are in it.

        Raises:
            ConfigError: something else is in the place.
            DataError: a label cannot be, such as one whose weight is not in [0, 1].
        """
        ...


def bad_weight(frame: str, k: int, weight: object) -> DataError:
    """What is wrong with a label whose weight cannot be."""
    return DataError(
        f"frame {frame}: label {k} has weight {weight!r}; weights are in [0, 1], something else "
        "has written this one: restore a backup"
    )


def refuse_link(path: Path) -> None:
    """ConfigError where an export would take the place of a link and leave what it leads to."""
    if path.is_symlink():
        raise ConfigError(
            f"{path}: is a link, in whose place the export would come; name what it leads to, or "
            "remove the link"
        )


def named(frames: Iterable[str]) -> str:
    """Some of the frames, as text."""
    names = sorted(frames)
    more = f" and {len(names) - _NAMED_FRAMES} more" if len(names) > _NAMED_FRAMES else ""
    return ", ".join(names[:_NAMED_FRAMES]) + more
