"""review.csv: one row per box, in which a person may write a decision.

The column `decision` takes `accept` or `reject`. `accept` in the row `all` of a frame accepts every
unchanged box of the frame that has no decision of its own. An unchanged box without a decision
counts as not looked at.
"""

import csv
import io
from dataclasses import dataclass, field
from pathlib import Path

from curate.datasets.frame_names import FrameNames
from curate.errors import DataError
from curate.files.atomic import replace_file
from curate.files.csv_text import read_csv
from curate.review.human_labels import ACCEPTED, REJECTED
from curate.review.sheet import Sheet, ShownFrame

TABLE = "review.csv"
COLUMNS = ("frame", "box", "asked", "category", "score", "weight", "decision")
ALL = "all"
_WORDS = {"accept": ACCEPTED, "accepted": ACCEPTED, "reject": REJECTED, "rejected": REJECTED}


@dataclass
class ExplicitDecisions:
    """The decisions written in the table for one frame.

    Attributes:
        boxes: accepted or rejected, by box number.
        accept_rest: whether all other unchanged boxes are accepted.
    """

    boxes: dict[int, str] = field(default_factory=dict)
    accept_rest: bool = False


def write_table(folder: Path, sheet: Sheet) -> None:
    """Write the table with an empty column `decision`."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for frame in sheet.frames:
        writer.writerow((frame.frame, ALL, "", "", "", "", ""))
        for number, box in enumerate(frame.boxes, start=1):
            asked = "yes" if box.asked else "human" if box.human else ""
            numbers = (f"{box.score:.3f}", f"{box.weight:.3f}")
            writer.writerow((frame.frame, number, asked, box.category, *numbers, ""))
    replace_file(folder / TABLE, text.getvalue().encode())


def read_table(folder: Path, sheet: Sheet) -> dict[str, ExplicitDecisions]:
    """Return the decisions by frame; none if the table is missing.

    Raises:
        DataError: if a row specifies a frame or box that is not in the review, or its decision is
            neither accept nor reject.
    """
    path = folder / TABLE
    if not path.is_file():
        return {}
    shown = {frame.frame: frame for frame in sheet.frames}
    frames = FrameNames(shown)
    found: dict[str, ExplicitDecisions] = {}
    for line, (name, box, decision) in read_csv(path, ("frame", "box", "decision")):
        if decision:
            place = f"{path}:{line}"
            frame = frames.require(name, place)
            words = found.setdefault(frame, ExplicitDecisions())
            _add_decision(shown[frame], box.lower(), decision.lower(), place, words)
    return found


def _add_decision(
    shown: ShownFrame, box: str, word: str, place: str, words: ExplicitDecisions
) -> None:
    if word not in _WORDS:
        raise DataError(f"{place}: invalid decision {word!r}; write accept, reject or nothing")
    if box == ALL:
        if _WORDS[word] == REJECTED:
            raise DataError(f"{place}: a whole frame cannot be rejected; reject its boxes")
        words.accept_rest = True
        return
    number, count = int(box) if box.isdecimal() else 0, len(shown.boxes)
    if not 1 <= number <= count:
        raise DataError(f"{place}: frame {shown.frame} has boxes 1 to {count}, not {box!r}")
    words.boxes[number] = _WORDS[word]
