"""The manifest of a review, review.json: its frames with their boxes, numbered by k.

The manifest stores every box as it was shown, so that the edits can be read even after the round
was computed again. Its id is a hash of its content, so that a changed manifest is detected.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from curate.errors import DataError
from curate.files.atomic import replace_file
from curate.files.json_text import read_json

MANIFEST = "review.json"
FORMAT = "curate review 1"
FIRST_PROPOSAL_K = 2_000_000
"""Proposal n of a frame is shown with the number k = FIRST_PROPOSAL_K + n."""


@dataclass(frozen=True)
class ShownBox:
    """A box that is shown to a person.

    Attributes:
        k: number of the prediction in its round, or of the human label in `weighted_labels`.
        category: its category.
        box: x, y, z, length, width, height, yaw in the LiDAR frame.
        score: of the detector; 1 for a human label, 0 for a proposal.
        weight: of the policy; 1 for a human label, 0 for a proposal.
        asked: whether a decision is requested; the other boxes are context.
        human: whether it already is a human label.
    """

    k: int
    category: str
    box: tuple[float, ...]
    score: float
    weight: float
    asked: bool
    human: bool = False

    @property
    def is_proposal(self) -> bool:
        """Whether it is a missed object of `curate propose`, which has no score and no weight."""
        return self.k >= FIRST_PROPOSAL_K


@dataclass(frozen=True)
class ShownFrame:
    """The boxes of a frame, by k."""

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
        round: e, the round of the labels.
        policy: the policy of the weights.
        editor: name of the format.
        categories: allowed in the edited files.
        frames: the shown frames.
    """

    round: int
    policy: str
    editor: str
    categories: tuple[str, ...]
    frames: tuple[ShownFrame, ...]

    @property
    def boxes(self) -> int:
        """Number of shown boxes."""
        return sum(len(frame.boxes) for frame in self.frames)

    @property
    def asked(self) -> int:
        """Number of boxes for which a decision is requested."""
        return sum(box.asked for frame in self.frames for box in frame.boxes)

    @property
    def id(self) -> str:
        """Hash of the content."""
        text = json.dumps(asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def write_sheet(folder: Path, sheet: Sheet) -> None:
    """Write the manifest of a review."""
    document = {"format": FORMAT, "id": sheet.id, **asdict(sheet)}
    replace_file(folder / MANIFEST, (json.dumps(document, indent=1) + "\n").encode())


def read_sheet(folder: Path) -> Sheet:
    """Read the manifest of a review.

    Raises:
        DataError: if it is missing, damaged or changed.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise DataError(
            f"{path}: no such file; import the folder that `curate review export` wrote"
        )
    document = read_json(path)
    if not isinstance(document, Mapping) or document.get("format") != FORMAT:
        raise DataError(f"{path}: not a review manifest; import the folder as it was exported")
    try:
        sheet = _sheet(document)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{path}: damaged ({error!r}); restore the file that was exported"
        ) from None
    if sheet.id != document.get("id"):
        raise DataError(
            f"{path}: changed since the export; restore it and write corrections into the label "
            "files instead"
        )
    return sheet


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
