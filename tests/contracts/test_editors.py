"""The contract of every registered editor format."""

import json
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from contracts.samples import assert_one_line, sample_of
from support.exported import toy_frame
from support.reviews import CYCLIST, small_sheet

from curate.errors import DataError
from curate.frames import Frame
from curate.geometry.similarity import wrap_angle
from curate.review.edits import check_boxes, compare_frame
from curate.review.sheet import Sheet
from pipelines.registry import EDITORS

# Change the text that holds the boxes of frame 000002.
Change = Callable[[Path, Callable[[str], str]], None]


def _change_file(name: str) -> Change:
    def change(folder: Path, edit: Callable[[str], str]) -> None:
        path = folder / name
        path.write_text(edit(path.read_text()))

    return change


def _change_zip(folder: Path, edit: Callable[[str], str]) -> None:
    path, member = folder / "annotations.zip", "annotations/default.json"
    with zipfile.ZipFile(path) as archive:
        text = archive.read(member).decode()
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(member, edit(text))


def _without_last_item(text: str) -> str:
    document = json.loads(text)
    document["items"].pop()
    return json.dumps(document)


# How to edit a returned file: change its text, remove frame 000002, add an unknown frame.
SAMPLES: Mapping[str, tuple[Change, Callable[[Path], None], Callable[[Path], None]]] = {
    "kitti": (
        _change_file("label_2/000002.txt"),
        lambda folder: (folder / "label_2/000002.txt").unlink(),
        lambda folder: (folder / "label_2/000077.txt").write_text(""),
    ),
    "labelcloud": (
        _change_file("labels/000002.json"),
        lambda folder: (folder / "labels/000002.json").unlink(),
        lambda folder: (folder / "labels/000077.json").write_text('{"objects": []}'),
    ),
    "cvat": (
        _change_zip,
        lambda folder: _change_zip(folder, _without_last_item),
        lambda folder: _change_zip(folder, lambda text: text.replace('"000002"', '"000077"')),
    ),
}


def read(name: str) -> Frame:
    """Return a function that reads a toy frame with an image."""
    frame = toy_frame(name)
    width, height = frame.image_size
    image = np.zeros((height, width, 3), dtype=np.uint8)
    return Frame(name, frame.points, frame.calibration, frame.image_size, image)


@pytest.fixture(params=sorted(EDITORS.classes))
def exported(request: pytest.FixtureRequest, tmp_path: Path):
    """Return an editor, its sheet, and the folder that it wrote."""
    editor = EDITORS.build(request.param, offered={}, options={})
    sheet = small_sheet(request.param)
    editor.write(tmp_path, sheet, read)
    return editor, sheet, tmp_path


def sample(name: str):
    """Return the function that edits the returned file of an editor."""
    description = (
        "three functions that change the boxes of a frame, take it away, add an unknown one"
    )
    return sample_of(SAMPLES, name, description)


def imported(editor, folder: Path, sheet: Sheet):
    """Return the boxes that an editor returned, after the checks."""
    found = editor.read(folder, sheet, read)
    for boxes in found.values():
        check_boxes(boxes, sheet.categories)
    return found


def test_an_unedited_export_is_imported_unchanged(exported) -> None:
    """Categories and order are the same, boxes within a millimetre; no decision is made."""
    editor, sheet, folder = exported
    found = imported(editor, folder, sheet)
    assert list(found) == ["000001", "000002"]
    for shown in sheet.frames:
        boxes = np.array([box.box for box in found[shown.frame]])
        assert [box.category for box in found[shown.frame]] == [box.category for box in shown.boxes]
        np.testing.assert_allclose(boxes[:, :6], shown.array[:, :6], atol=1e-3)
        assert np.abs(wrap_angle(boxes[:, 6] - shown.array[:, 6])).max() < 1e-3
        assert compare_frame(shown, found[shown.frame]).decisions == ()


def test_a_frame_missing_from_the_import_was_not_reviewed(exported) -> None:
    """It is left out, and the others are read."""
    editor, sheet, folder = exported
    sample(editor.name)[1](folder)
    assert list(imported(editor, folder, sheet)) == ["000001"]


def test_an_unknown_frame_is_rejected(exported) -> None:
    """The one-line error contains its name."""
    editor, sheet, folder = exported
    sample(editor.name)[2](folder)
    with pytest.raises(DataError, match="'000077'") as error:
        editor.read(folder, sheet, read)
    assert_one_line(error.value)


@pytest.mark.parametrize(
    "edit",
    [
        lambda text: text.replace("Cyclist", "Tricycle"),
        lambda text: text[: len(text) // 2],
        lambda text: text.replace("1.8", "NaN", 1) if "NaN" not in text else text,
        lambda text: text.replace("1.8", "broad", 1),
    ],
    ids=["category", "half", "nan", "word"],
)
def test_a_damaged_file_gives_a_one_line_error(exported, edit: Callable[[str], str]) -> None:
    """The message contains the file, whatever the damage; no other exception is raised."""
    editor, sheet, folder = exported
    before = imported(editor, folder, sheet)["000002"]
    assert before[0].box[3] == pytest.approx(CYCLIST[3])
    sample(editor.name)[0](folder, edit)
    with pytest.raises(DataError, match=r"000002|default\.json") as error:
        imported(editor, folder, sheet)
    assert_one_line(error.value)


def test_a_missing_file_is_rejected(exported, tmp_path: Path) -> None:
    editor, sheet, _ = exported
    with pytest.raises(DataError, match="nowhere") as error:
        editor.read(tmp_path / "nowhere", sheet, read)
    assert_one_line(error.value)
