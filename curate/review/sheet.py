"""What a review shows: frames with numbered boxes, written to and read from review.json.

The manifest holds every box as it was shown, so that the answer can be understood after the round
has gone on; its id is a hash of its content, so that a changed one is noticed.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from curate.errors import DataError, one_line
from curate.files.atomic import replace_file

MANIFEST = "review.json"
FORMAT = "curate review 1"


@dataclass(frozen=True)
class ShownBox:
    """A box that a person is shown.

    Attributes:
        k: number of the prediction in its round, or of the human label in `weighted_labels`.
        category: its category.
        box: x, y, z, length, width, height, yaw in the LiDAR frame.
        score: of the detector; 1 for a human label.
        weight: of the policy; 1 for a human label.
        asked: whether an opinion on it is wanted; the others are context.
        human: whether it is a human label already.
    """

    k: int
    category: str
    box: tuple[float, ...]
    score: float
    weight: float
    asked: bool
    human: bool = False


@dataclass(frozen=True)
class ShownFrame:
    """The boxes of a frame; number i of a person's view is place i - 1 here."""

    frame: str
    boxes: tuple[ShownBox, ...]

    @property
    def array(self) -> np.ndarray:
        """(n, 7) boxes in the LiDAR frame."""
        return np.array([shown.box for shown in self.boxes], dtype=np.float64).reshape(-1, 7)


@dataclass(frozen=True)
class Sheet:
    """A review.

    Attributes:
        round: whose labels.
        policy: whose weights.
        editor: name of the format.
        categories: that an answer may name.
        frames: what is shown.
    """

    round: int
    policy: str
    editor: str
    categories: tuple[str, ...]
    frames: tuple[ShownFrame, ...]

    @property
    def boxes(self) -> int:
        """How many boxes are shown."""
        return sum(len(frame.boxes) for frame in self.frames)

    @property
    def asked(self) -> int:
        """On how many boxes an opinion is wanted."""
        return sum(box.asked for frame in self.frames for box in frame.boxes)

    @property
    def id(self) -> str:
        """A hash of all of it."""
        text = json.dumps(asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def write_sheet(folder: Path, sheet: Sheet) -> None:
    """Writes the manifest of a review."""
    document = {"format": FORMAT, "id": sheet.id, **asdict(sheet)}
    replace_file(folder / MANIFEST, (json.dumps(document, indent=1) + "\n").encode())


def read_sheet(folder: Path) -> Sheet:
    """The manifest of a review.

    Raises:
        DataError: it is missing, damaged, or has been changed.
    """
    path = folder / MANIFEST
    document = read_json(path, "; import the folder that `curate review export` wrote")
    if not isinstance(document, Mapping) or document.get("format") != FORMAT:
        raise DataError(f"{path}: is no manifest of a review; import the folder as exported")
    try:
        sheet = _sheet(document)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: is damaged ({error!r}); take it back from the export") from None
    if sheet.id != document.get("id"):
        raise DataError(
            f"{path}: has been changed since the export; take it back, corrections go into the "
            "label files"
        )
    return sheet


def read_json(path: Path, remedy: str = "") -> Any:
    """The content of a JSON file.

    Raises:
        DataError: it is missing or damaged.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError(f"{path}: no such file{remedy}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: is no readable JSON: {one_line(error)}") from None


def _sheet(document: Mapping[str, Any]) -> Sheet:
    frames = tuple(
        ShownFrame(
            str(frame["frame"]),
            tuple(
                ShownBox(**{**shown, "box": tuple(map(float, shown["box"]))})
                for shown in frame["boxes"]
            ),
        )
        for frame in document["frames"]
    )
    return Sheet(
        int(document["round"]),
        str(document["policy"]),
        str(document["editor"]),
        tuple(map(str, document["categories"])),
        frames,
    )
