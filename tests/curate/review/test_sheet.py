"""The manifest of a review and its table."""

import json
from pathlib import Path

import pytest
from support.reviews import small_sheet

from curate.errors import DataError
from curate.review.sheet import MANIFEST, read_sheet, write_sheet
from curate.review.table import TABLE, read_table, write_table


def test_a_manifest_is_read_back(tmp_path: Path) -> None:
    """To the last digit, with the same id."""
    write_sheet(tmp_path, small_sheet())
    again = read_sheet(tmp_path)
    assert again == small_sheet()
    assert again.id == json.loads((tmp_path / MANIFEST).read_text())["id"]
    assert (again.boxes, again.asked) == (4, 3)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('"category": "Car"', '"category": "Van"', "changed since the export"),
        ('"frames"', '"pages"', "damaged"),
        ("curate review 1", "curate review 9", "not a review manifest"),
        ("{", "", "cannot be read as JSON"),
    ],
)
def test_a_changed_manifest_is_rejected(
    tmp_path: Path, before: str, after: str, message: str
) -> None:
    """The one-line error contains the file."""
    write_sheet(tmp_path, small_sheet())
    path = tmp_path / MANIFEST
    path.write_text(path.read_text().replace(before, after, 1))
    with pytest.raises(DataError, match=f"{MANIFEST}:.*{message}") as error:
        read_sheet(tmp_path)
    assert "\n" not in str(error.value)


def test_a_folder_without_manifest_is_rejected(tmp_path: Path) -> None:
    """The error says which folder to specify."""
    with pytest.raises(DataError, match=r"no such file; import the folder that"):
        read_sheet(tmp_path)


def edited(folder: Path, **decisions: str) -> None:
    """Write decisions into the table, by frame and box such as f000001_2 or f000001_all."""
    write_table(folder, small_sheet())
    lines = (folder / TABLE).read_text().splitlines()
    for key, word in decisions.items():
        start = ",".join(key[1:].split("_")) + ","
        lines = [line + word if line.startswith(start) else line for line in lines]
    (folder / TABLE).write_text("\n".join(lines) + "\n")


def test_an_empty_column_has_no_decisions(tmp_path: Path) -> None:
    """Nor does a missing table."""
    assert read_table(tmp_path, small_sheet()) == {}
    edited(tmp_path)
    assert read_table(tmp_path, small_sheet()) == {}


def test_decisions_are_read(tmp_path: Path) -> None:
    """Of boxes, and of all others of a frame."""
    edited(tmp_path, f000001_1="accept", f000001_2="Rejected", f000002_all="accept")
    words = read_table(tmp_path, small_sheet())
    assert words["000001"].boxes == {1: "accepted", 2: "rejected"}
    assert (words["000001"].accept_rest, words["000002"].accept_rest) == (False, True)


def test_changes_by_spreadsheet_programs_are_tolerated(tmp_path: Path) -> None:
    """Semicolons, a byte order mark, no leading zeros."""
    edited(tmp_path, f000002_1="accept")
    text = (tmp_path / TABLE).read_text().replace(",", ";").replace("00000", "")
    (tmp_path / TABLE).write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert read_table(tmp_path, small_sheet())["000002"].boxes == {1: "accepted"}


@pytest.mark.parametrize(
    ("key", "word", "before", "after", "message"),
    [
        ("f000001_1", "maybe", "", "", "3: invalid decision 'maybe'; write accept, reject"),
        ("f000001_all", "reject", "", "", "2: a whole frame cannot be rejected"),
        ("f000001_2", "accept", "000001,2", "000001,7", "frame 000001 has boxes 1 to 3, not '7'"),
        ("f000001_2", "accept", "000001,2", "000009,2", "there is no frame '000009'"),
        (
            "f000001_2",
            "accept",
            "decision",
            "opinion",
            "1: no column decision in the header",
        ),
    ],
)
def test_invalid_rows_are_rejected(
    tmp_path: Path, key: str, word: str, before: str, after: str, message: str
) -> None:
    """With file and line."""
    edited(tmp_path, **{key: word})
    path = tmp_path / TABLE
    path.write_text(path.read_text().replace(before or "\0", after))
    with pytest.raises(DataError, match=f"{TABLE}:.*{message}"):
        read_table(tmp_path, small_sheet())
