"""review.csv: one row per label, in which a person may write a decision.

A label has the number k that it has everywhere else: in pictures, `curate explain` and queries. In
tables of curate 0.1 the column `box` counts the labels of a frame from 1; they are read, too.

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
from curate.files.csv_text import column_names, read_csv
from curate.review.human_labels import ACCEPTED, REJECTED
from curate.review.sheet import Sheet, ShownFrame

TABLE = "review.csv"
COLUMNS = ("frame", "k", "asked", "category", "score", "weight", "decision")
ALL = "all"
_OLD_NUMBER = "box"
_WORDS = {"accept": ACCEPTED, "accepted": ACCEPTED, "reject": REJECTED, "rejected": REJECTED}


@dataclass
class ExplicitDecisions:
    """The decisions written in the table for one frame.

    Attributes:
        boxes: accepted or rejected, by k.
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
        for box in frame.boxes:
            asked = "yes" if box.asked else "human" if box.human else ""
            numbers = (f"{box.score:.3f}", f"{box.weight:.3f}")
            if box.is_proposal:
                numbers = ("", "")
            writer.writerow((frame.frame, box.k, asked, box.category, *numbers, ""))
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
    column = _OLD_NUMBER if _OLD_NUMBER in column_names(path) else "k"
    found: dict[str, ExplicitDecisions] = {}
    for line, (name, label, decision) in read_csv(path, ("frame", column, "decision")):
        if decision:
            place = f"{path}:{line}"
            frame = frames.require(name, place)
            words = found.setdefault(frame, ExplicitDecisions())
            _add_decision(shown[frame], (column, label.lower()), decision.lower(), place, words)
    return found


def _add_decision(
    shown: ShownFrame, label: tuple[str, str], word: str, place: str, words: ExplicitDecisions
) -> None:
    """Add the decision of a row; `label` is the name of its column of numbers, and the number."""
    column, number = label
    if word not in _WORDS:
        raise DataError(f"{place}: invalid decision {word!r}; write accept, reject or nothing")
    if number == ALL:
        if _WORDS[word] == REJECTED:
            raise DataError(f"{place}: a whole frame cannot be rejected; reject its boxes")
        words.accept_rest = True
        return
    known = {str(each.k): each.k for each in shown.boxes}
    if column == _OLD_NUMBER:
        known = {str(place): each.k for place, each in enumerate(shown.boxes, start=1)}
    if number not in known:
        raise DataError(
            f"{place}: {column} {number!r} is not in frame {shown.frame} of this review; it has "
            f"{', '.join(known) or 'no labels'}"
        )
    words.boxes[known[number]] = _WORDS[word]
