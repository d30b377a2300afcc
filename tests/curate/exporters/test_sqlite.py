"""The label file: its schema, what it refuses, and that it is whole or absent."""

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from support.exported import toy_labels

from curate.errors import DataError, LeakageError
from curate.exporters.base import LabelFileDescription
from curate.exporters.label_file import read_frames
from curate.exporters.sqlite import SqliteExporter, write_labels

DESCRIPTION = LabelFileDescription(
    "kitti", Path("/data/kitti"), ("Car", "Cyclist"), 2, "pspsl", "1"
)
BOX = (10.0, 1.0, -0.8, 4.0, 1.6, 1.5, 0.5)


def frame(name, split):
    """A row of `frame`."""
    return (name, split, f"velodyne/{name}.bin", f"image_2/{name}.png", f"calib/{name}.txt")


def truth(name, k=0):
    """A row of `ground_truth`."""
    return (name, k, "Car", *BOX, 0.0, 0)


def label(name, k=0, weight=0.5, **changes):
    """A row of `label`, in the order of the view."""
    row = {
        "round": 2, "frame": name, "k": k, "category": "Car",
        "x": BOX[0], "y": BOX[1], "z": BOX[2], "length": BOX[3], "width": BOX[4],
        "height": BOX[5], "yaw": BOX[6], "score": 0.9, "loss": 0.2, "points": 30,
        "points_threshold": 60.0, "rho_diff": 0.5, "mask_pixels": 80, "box_pixels": 100,
        "rho_anno": 0.8, "rho_det": 0.4, "lambda_u": 1.5,
        "provenance": "detector", "policy": "pspsl", "weight": weight,
    } | changes  # fmt: skip
    return tuple(row.values())


FRAMES = [frame("a", "labeled"), frame("b", "unlabeled"), frame("c", "unlabeled")]


def write(path, frames=FRAMES, ground_truth=(), labels=()):
    """Writes a label file of iterators, which can be read only once."""
    write_labels(
        path,
        description=DESCRIPTION,
        frames=iter(frames),
        ground_truth=iter(ground_truth),
        labels=iter(labels),
    )


def select(path, query):
    """All rows of a query on a label file."""
    with closing(sqlite3.connect(path)) as connection:
        return connection.execute(query).fetchall()


def test_the_view_has_exactly_the_documented_columns_in_order(tmp_path):
    """`weighted_labels` is what the data model promises, row by row as it was given."""
    path = tmp_path / "exports" / "labels.sqlite"
    write(path, labels=[label("b"), label("b", 1, 0.0, loss=None)])
    with closing(sqlite3.connect(path)) as connection:
        cursor = connection.execute("SELECT * FROM weighted_labels ORDER BY k")
        names = ", ".join(column[0] for column in cursor.description)
        assert cursor.fetchall() == [label("b"), label("b", 1, 0.0, loss=None)]
    assert names == (
        "round, frame, k, category, x, y, z, length, width, height, yaw, score, loss, points, "
        "points_threshold, rho_diff, mask_pixels, box_pixels, rho_anno, rho_det, lambda_u, "
        "provenance, policy, weight"
    )


def test_meta_says_what_the_labels_are_about(tmp_path):
    """Data set, root, categories, round, policy, versions."""
    path = tmp_path / "labels.sqlite"
    write(path)
    meta = dict(select(path, "SELECT key, value FROM meta"))
    assert json.loads(meta.pop("categories")) == ["Car", "Cyclist"]
    assert meta == {
        "format_version": "1",
        "dataset": "kitti",
        "root": "/data/kitti",
        "round": "2",
        "policy": "pspsl",
        "code_version": "1",
    }


def test_ground_truth_of_an_unlabeled_frame_is_refused_by_name(tmp_path):
    """The leak is an error that names the frames, and no file is left."""
    path = tmp_path / "labels.sqlite"
    with pytest.raises(LeakageError, match=r"labels\.sqlite: ground truth of .* split: b, zz;"):
        write(path, ground_truth=[truth("a"), truth("b"), truth("zz"), truth("b", 1)])
    assert list(tmp_path.iterdir()) == []


def test_val_frames_are_refused(tmp_path):
    """A frame of a third split cannot be written at all."""
    with pytest.raises(LeakageError, match="val"):
        write(tmp_path / "labels.sqlite", frames=[frame("a", "val")])


def test_labels_of_labeled_frames_are_refused(tmp_path):
    """Where there is ground truth there are no pseudo-labels."""
    with pytest.raises(DataError, match="labels of frames outside the unlabeled split: a"):
        write(tmp_path / "labels.sqlite", labels=[label("a")])


def test_the_finished_file_refuses_ground_truth_of_unlabeled_frames_too(tmp_path):
    """The schema itself ties ground truth to the labeled split, for whoever writes later."""
    path = tmp_path / "labels.sqlite"
    write(path)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA foreign_keys = ON")
        names = "frame, k, category, x, y, z, length, width, height, yaw, truncated, occluded"
        marks = ", ".join("?" * 12)
        insert = f"INSERT INTO ground_truth ({names}) VALUES ({marks})"
        connection.execute(insert, truth("a"))
        with pytest.raises(sqlite3.IntegrityError, match="FOREIGN KEY"):
            connection.execute(insert, truth("b"))


@pytest.mark.parametrize(
    "row",
    [
        label("b", weight=1.5),
        label("b", weight=None),
        label("b", length=float("nan")),
        label("b", length=-1.0),
        label("b", points="many"),
        label("b")[:-1],
    ],
)
def test_a_row_that_does_not_fit_is_refused(tmp_path, row):
    """Weights outside [0, 1], NaN, sides below zero, text for a number, and missing columns."""
    with pytest.raises(DataError, match=r"labels\.sqlite: a row|label 0 has weight 1\.5"):
        write(tmp_path / "labels.sqlite", labels=[row])
    assert list(tmp_path.iterdir()) == []


def test_the_same_label_twice_is_refused(tmp_path):
    """Frame and k name a label."""
    with pytest.raises(DataError, match="UNIQUE"):
        write(tmp_path / "labels.sqlite", labels=[label("b"), label("b")])


def test_a_failing_source_of_rows_leaves_the_old_file(tmp_path):
    """When the rows break off, the file that was there is still there, whole."""
    path = tmp_path / "labels.sqlite"
    write(path, labels=[label("b")])

    def broken():
        yield label("c")
        raise KeyError("the source broke")

    with pytest.raises(KeyError):
        write(path, labels=broken())
    assert select(path, "SELECT frame FROM weighted_labels") == [("b",)]
    assert [file.name for file in tmp_path.iterdir()] == ["labels.sqlite"]


def test_a_frame_is_found_by_index(tmp_path):
    """Asking for the labels of one frame does not scan the table."""
    path = tmp_path / "labels.sqlite"
    write(path, labels=[label(name, k) for name in "bc" for k in range(200)])
    plan = select(path, "EXPLAIN QUERY PLAN SELECT weight FROM weighted_labels WHERE frame = 'b'")
    assert "USING INDEX label_frame" in plan[0][3]


def test_a_file_that_another_program_writes_is_not_taken_for_a_foreign_one(tmp_path):
    """Neither where it would be replaced nor where it is read; once let go it is."""
    path = tmp_path / "labels.sqlite"
    SqliteExporter().write(path, toy_labels())
    with closing(sqlite3.connect(path, isolation_level=None, timeout=0)) as other:
        other.execute("BEGIN EXCLUSIVE")
        for look in (lambda: SqliteExporter().write(path, toy_labels()), lambda: read_frames(path)):
            with pytest.raises(DataError, match="another program writes into it"):
                look()
        other.execute("ROLLBACK")
    SqliteExporter().write(path, toy_labels())
