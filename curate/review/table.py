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

from curate.errors import DataError
from curate.files.atomic import replace_file
from curate.review.human_labels import ACCEPTED, REJECTED
from curate.review.sheet import Sheet

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
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a UTF-8 text file (byte {error.start})") from None
    # In some languages spreadsheets save CSV with semicolons.
    delimiter = ";" if ";" in text.partition("\n")[0] else ","
    rows = csv.DictReader(io.StringIO(text), delimiter=delimiter)
    rows.fieldnames = [name.strip() for name in rows.fieldnames or ()]
    names = set(rows.fieldnames)
    if not {"frame", "decision"} <= names or names.isdisjoint({"k", _OLD_NUMBER}):
        raise DataError(f"{path}:1: the columns frame, k and decision are required")
    found: dict[str, ExplicitDecisions] = {}
    for row in rows:
        word = (row["decision"] or "").strip().lower()
        if word:
            _add_decision(row, word, f"{path}:{rows.line_num}", sheet, found)
    return found


def _add_decision(
    row: dict[str, str], word: str, place: str, sheet: Sheet, found: dict[str, ExplicitDecisions]
) -> None:
    if word not in _WORDS:
        raise DataError(f"{place}: invalid decision {word!r}; write accept, reject or nothing")
    name = _frame(row["frame"], place, sheet)
    words = found.setdefault(name, ExplicitDecisions())
    name_of_number = "k" if "k" in row else _OLD_NUMBER
    number = (row[name_of_number] or "").strip().lower()
    if number == ALL:
        if _WORDS[word] == REJECTED:
            raise DataError(f"{place}: a whole frame cannot be rejected; reject its boxes")
        words.accept_rest = True
        return
    boxes = next(frame for frame in sheet.frames if frame.frame == name).boxes
    shown = {str(box.k): box.k for box in boxes}
    if name_of_number == _OLD_NUMBER:
        shown = {str(position): box.k for position, box in enumerate(boxes, start=1)}
    if number not in shown:
        raise DataError(
            f"{place}: {name_of_number} {number!r} is not in frame {name} of this review; it has "
            f"{', '.join(shown) or 'no labels'}"
        )
    words.boxes[shown[number]] = _WORDS[word]


def _frame(name: str, place: str, sheet: Sheet) -> str:
    """Return the frame of a row; spreadsheets remove leading zeros."""
    names = [frame.frame for frame in sheet.frames]
    matches = [each for each in names if each.lstrip("0") == name.strip().lstrip("0")]
    if name in names:
        return name
    if len(matches) != 1:
        raise DataError(f"{place}: frame '{name}' is not in this review")
    return matches[0]
