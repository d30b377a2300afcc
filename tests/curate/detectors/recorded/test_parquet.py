"""Recorded detections in Parquet."""

import logging
from pathlib import Path

import numpy as np
import pytest
from support.exported import BOXES, CATEGORIES, SCORES, toy_labels
from support.fatal_files import write_aborting_parquet
from support.toys import empty_frame

from curate.detectors.recorded import RecordedDetector
from curate.errors import ConfigError, DataError
from curate.exporters.parquet import ParquetExporter
from curate.geometry.similarity import Similarity

arrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")


def table(**changes):
    """Return two boxes of frame a and one of b, with some columns changed or left out (None)."""
    columns = {
        "frame": ["a", "a", "b"],
        "category": ["Car", "Pedestrian", "Car"],
        "score": [0.9, 0.2, 0.5],
        **{name: [float(i), 1.0, 2.0] for i, name in enumerate("xyz")},
        **{name: [4.0, 1.0, 4.0] for name in ("length", "width", "height")},
        "yaw": [0.5, 0.5, 4.0],
    } | changes
    return arrow.table({name: values for name, values in columns.items() if values is not None})


def write(path: Path, *, group=2, **changes) -> Path:
    """Write the table in row groups."""
    parquet.write_table(table(**changes), path, row_group_size=group)
    return path


def test_the_names_of_all_rows_are_known(tmp_path):
    """In any row group, plain or as a dictionary."""
    names = {"Car", "Pedestrian", "Van"}
    plain = write(tmp_path / "a.parquet", category=["Car", "Pedestrian", "Van"])
    assert RecordedDetector(plain).category_names() == names
    encoded = arrow.array(["Car", "Pedestrian", "Van"]).dictionary_encode()
    path = write(tmp_path / "b.parquet", category=encoded)
    assert RecordedDetector(path).category_names() == names


def test_our_own_export_can_be_read_as_a_record(tmp_path):
    """Boxes, scores and categories to the last bit, for any size of row groups."""
    ParquetExporter(rows_per_group=2).write(tmp_path / "labels.parquet", toy_labels())
    record = RecordedDetector(tmp_path / "labels.parquet")
    assert record.frame_ids() == ("000001",)
    found = record.predict(empty_frame("000001"))
    assert found.boxes.tolist() == [list(box) for box in BOXES]
    assert found.scores.tolist() == list(SCORES)
    assert found.categories.tolist() == list(CATEGORIES)


def test_rows_can_have_any_order_and_type(tmp_path):
    """Numbers as integers, names as dictionaries, frames as numbers, spread over row groups."""
    path = write(
        tmp_path / "a.parquet",
        group=1,
        frame=[7, 8, 7],
        category=arrow.array(["Car", "Pedestrian", "Car"]).dictionary_encode(),
        x=[1, 2, 3],
    )
    record = RecordedDetector(path)
    assert record.frame_ids() == ("7", "8")
    assert record.predict(empty_frame("7")).boxes[:, 0].tolist() == [1, 3]
    assert record.predict(empty_frame("7")).boxes[1, 6] == pytest.approx(4.0 - 2 * np.pi)


def test_views_are_in_the_same_file(tmp_path):
    """View 0 is the frame, the others are copies in their own frame of reference."""
    path = write(
        tmp_path / "a.parquet",
        frame=["a", "a", "b"],
        view=[0, 1, 2],
        flip_y=[False, True, False],
        rotation_rad=[0.0, 0.3, 0.1],
        scale=[1.0, 1.05, 1.0],
    )
    record = RecordedDetector(path)
    assert len(record.predict(empty_frame("a"))) == 1
    [(similarity, found)] = record.views("a")
    assert similarity == Similarity(flip_y=True, rotation_rad=0.3, scale=1.05)
    assert found.categories.tolist() == ["Pedestrian"]
    assert len(record.predict(empty_frame("b"))) == 0
    assert len(record.views("b")) == 1


def test_missing_views_are_reported_once(tmp_path, caplog):
    """An export of labels has none."""
    record = RecordedDetector(write(tmp_path / "a.parquet"))
    with caplog.at_level(logging.WARNING):
        assert list(record.views("a")) == list(record.views("b")) == []
    assert len(caplog.messages) == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"score": None, "yaw": None}, "no column score, yaw; it has frame, category, x"),
        ({"view": [0, 0, 0]}, "no column flip_y, rotation_rad, scale"),
        ({"x": ["1", "2", "3"]}, "column x is of type string"),
        ({"frame": ["a", None, "b"]}, "row group 0: no frame in 1 of 2 rows"),
    ],
)
def test_a_file_that_cannot_be_a_record_is_rejected(tmp_path, changes, message):
    """At once, in one line."""
    path = write(tmp_path / "a.parquet", **changes)
    with pytest.raises(DataError, match=message) as caught:
        RecordedDetector(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


VIEWS = {"view": [0, 1, 1], "flip_y": [0, 1, 1], "rotation_rad": [0, 0, 0], "scale": [1, 1, 1]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"score": [0.9, 1.5, 0.5]}, "frame a: scores up to 1.5 are not in"),
        ({"length": [0.0, 1.0, 4.0]}, "frame a: box 0: length, width or height is not positive"),
        ({"z": [np.nan, 1.0, 4.0]}, "frame a: box 0: a number is NaN"),
        ({"z": [None, 1.0, 4.0]}, "row group 0: no z in 1 of 2 rows"),
        (VIEWS | {"view": [0.5, 1, 1]}, "box 0: view is not 0, 1, 2"),
        (VIEWS | {"flip_y": [0, 2, 1]}, "box 1: flip_y is neither"),
        (VIEWS | {"scale": [2, 1, 1]}, "box 0: view 0 is the original frame"),
        (VIEWS | {"scale": [1, -1, 1]}, "box 1: scale is not positive"),
        (VIEWS | {"view": [1, 1, 1]}, "box 1: flip_y, rotation_rad or scale differ within a view"),
    ],
)
def test_an_invalid_row_fails_only_its_frame(tmp_path, changes, message):
    """Frame b is in another row group."""
    record = RecordedDetector(write(tmp_path / "a.parquet", **changes))
    with pytest.raises(DataError, match=message) as caught:
        record.predict(empty_frame("a"))
    assert "\n" not in str(caught.value)
    record.predict(empty_frame("b"))


@pytest.mark.parametrize("content", [b"", b"PAR1", b"no parquet at all"])
def test_a_damaged_file_is_rejected(tmp_path, content):
    (tmp_path / "a.parquet").write_bytes(content)
    with pytest.raises(DataError, match=r"a\.parquet: not a readable Parquet file") as caught:
        RecordedDetector(tmp_path / "a.parquet")
    assert "\n" not in str(caught.value)


def test_damaged_rows_are_reported(tmp_path):
    """The footer may be intact if the rows are not."""
    path = write(tmp_path / "a.parquet", group=3)
    content = bytearray(path.read_bytes())
    content[4:60] = bytes(56)
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"a\.parquet: ") as caught:
        RecordedDetector(path).predict(empty_frame("a"))
    assert "\n" not in str(caught.value)


def test_a_table_accepts_no_second_pass_files(tmp_path):
    """Its copies are views."""
    with pytest.raises(ConfigError, match="a table contains its augmented copies as views"):
        RecordedDetector(write(tmp_path / "a.parquet"), passes=[{"path": "b", "flip_y": True}])


def test_only_a_few_row_groups_are_in_memory(tmp_path, monkeypatch):
    """For files of any size."""
    path = tmp_path / "a.parquet"
    one = table(frame=["a"] * 3)
    names = [f"{i:04d}" for i in range(300)]
    rows = arrow.concat_tables(
        [one.set_column(0, "frame", arrow.array([name] * 3)) for name in names]
    )
    parquet.write_table(rows, path, row_group_size=30)
    record = RecordedDetector(path)
    assert record.frame_ids() == tuple(names)
    read, read_row_group = [], parquet.ParquetFile.read_row_group

    def counted(file, number, **options):
        read.append(number)
        return read_row_group(file, number, **options)

    monkeypatch.setattr(parquet.ParquetFile, "read_row_group", counted)
    for name in names:
        assert len(record.predict(empty_frame(name))) == 3
    assert read == list(range(30))
    read.clear()
    for name in reversed(names):
        assert len(record.predict(empty_frame(name))) == 3
    # Cached row groups are not read again.
    cached = 30 - len(read)
    assert cached <= 2
    assert read == list(reversed(range(30 - cached)))


def test_a_file_that_makes_pyarrow_abort_is_rejected(tmp_path):
    """Case 24: it ended the process with SIGABRT."""
    write_aborting_parquet(tmp_path / "a.parquet")
    with pytest.raises(
        DataError, match=r"pyarrow ends the process \(SIGABRT: Definition"
    ) as caught:
        RecordedDetector(tmp_path / "a.parquet")
    assert "\n" not in str(caught.value)


def test_a_file_without_the_column_of_frames_is_rejected(tmp_path):
    """Also if another column of text is missing."""
    path = write(tmp_path / "a.parquet", frame=None, category=None)
    with pytest.raises(DataError, match="no column frame, category; it has score"):
        RecordedDetector(path)
