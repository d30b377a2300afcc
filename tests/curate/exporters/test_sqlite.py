"""The label file: its schema, what it rejects, and atomic writing."""

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import URL
from support import exported
from support.exported import toy_frame, toy_labels

from curate.errors import DataError, LeakageError
from curate.exporters.base import FrameFiles, LabelFileDescription, LabelSet
from curate.exporters.columns import WEIGHTED_LABELS, Column
from curate.exporters.label_file import read_frames
from curate.exporters.sqlite import SqliteExporter
from curate.training.labels import WeightedLabels
from pipelines.queries.run_query import run_query

DESCRIPTION = LabelFileDescription(
    "kitti", Path("/data/kitti"), ("Car", "Cyclist"), 2, "pspsl", "1"
)
BOX = (10.0, 1.0, -0.8, 4.0, 1.6, 1.5, 0.5)


def frame(name, split):
    """Return a frame and its files."""
    return FrameFiles(
        name, split, f"velodyne/{name}.bin", f"image_2/{name}.png", f"calib/{name}.txt"
    )


def truth(name, k=0):
    """Return a ground-truth object."""
    return exported.truth(name, k, BOX)


def label(name, k=0, weight=0.5, **changes):
    """Return a label of round 2."""
    return exported.label(name, k, BOX, round=2, weight=weight, **changes)


FRAMES = [frame("a", "labeled"), frame("b", "unlabeled"), frame("c", "unlabeled")]


def write(path, frames=FRAMES, ground_truth=(), labels=(), columns=WEIGHTED_LABELS):
    """Write a label file with blocks of one label."""
    names = [column.name for column in columns]
    given = LabelSet(
        DESCRIPTION,
        list(frames),
        exported.truth_block(ground_truth),
        (exported.block([row], names) for row in labels),
        read=toy_frame,
        read_points=toy_frame,
        columns=columns,
    )
    return SqliteExporter().write(path, given)


def select(path, query):
    """Return all rows of a query on a label file."""
    with closing(sqlite3.connect(path)) as connection:
        return connection.execute(query).fetchall()


def test_the_view_has_exactly_the_documented_columns_in_order(tmp_path):
    """`weighted_labels` follows the data model, row by row."""
    path = tmp_path / "exports" / "labels.sqlite"
    write(path, labels=[label("b"), label("b", 1, 0.0, loss=None)])
    with closing(sqlite3.connect(path)) as connection:
        cursor = connection.execute("SELECT * FROM weighted_labels ORDER BY k")
        names = ", ".join(column[0] for column in cursor.description)
        expected = [label("b"), label("b", 1, 0.0, loss=None)]
        assert cursor.fetchall() == [tuple(row.values()) for row in expected]
    assert names == (
        "round, frame, k, category, x, y, z, length, width, height, yaw, score, loss, points, "
        "points_threshold, rho_diff, mask_pixels, box_pixels, rho_anno, rho_det, lambda_u, "
        "provenance, policy, weight"
    )


def test_meta_describes_the_labels(tmp_path):
    """Dataset, root, categories, round, policy, versions."""
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
        "zero_weight": "background",
        "code_version": "1",
    }


def test_ground_truth_of_an_unlabeled_frame_is_rejected(tmp_path):
    """The error lists the frames, and no file is left."""
    path = tmp_path / "labels.sqlite"
    with pytest.raises(LeakageError, match=r"ground truth of .* split: b, zz;"):
        write(path, ground_truth=[truth("a"), truth("b"), truth("zz"), truth("b", 1)])
    assert list(tmp_path.iterdir()) == []


def test_val_frames_are_rejected(tmp_path):
    with pytest.raises(LeakageError, match="val"):
        write(tmp_path / "labels.sqlite", frames=[frame("a", "val")])


def test_labels_of_labeled_frames_are_rejected(tmp_path):
    """Frames with ground truth have no pseudo-labels."""
    with pytest.raises(DataError, match="labels of frames outside the unlabeled split: a"):
        write(tmp_path / "labels.sqlite", labels=[label("a")])


def test_the_finished_file_rejects_ground_truth_of_unlabeled_frames_too(tmp_path):
    """The schema itself restricts ground truth to the labeled split, for later writers as well."""
    path = tmp_path / "labels.sqlite"
    write(path)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA foreign_keys = ON")
        names = "frame, k, category, x, y, z, length, width, height, yaw, truncated, occluded"
        marks = ", ".join("?" * 12)
        insert = f"INSERT INTO ground_truth ({names}) VALUES ({marks})"
        columns = names.split(", ")
        connection.execute(insert, [truth("a")[name] for name in columns])
        with pytest.raises(sqlite3.IntegrityError, match="FOREIGN KEY"):
            connection.execute(insert, [truth("b")[name] for name in columns])


@pytest.mark.parametrize(
    "row",
    [
        label("b", weight=1.5),
        label("b", weight=None),
        label("b", length=float("nan")),
        label("b", length=-1.0),
        label("b", points="many"),
    ],
)
def test_a_row_that_does_not_fit_is_rejected(tmp_path, row):
    """Weights outside [0, 1], NaN, negative sizes, and text for a number."""
    with pytest.raises(DataError, match=r"labels\.sqlite: a row|label 0 has weight (1\.5|None)"):
        write(tmp_path / "labels.sqlite", labels=[row])
    assert list(tmp_path.iterdir()) == []


def test_a_duplicate_label_is_rejected(tmp_path):
    """Frame and k identify a label."""
    with pytest.raises(DataError, match="UNIQUE"):
        write(tmp_path / "labels.sqlite", labels=[label("b"), label("b")])


def test_a_failing_source_of_rows_leaves_the_old_file(tmp_path):
    """The complete earlier file stays."""
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
    """A query for the labels of one frame does not scan the table."""
    path = tmp_path / "labels.sqlite"
    write(path, labels=[label(name, k) for name in "bc" for k in range(200)])
    plan = select(path, "EXPLAIN QUERY PLAN SELECT weight FROM weighted_labels WHERE frame = 'b'")
    assert "USING INDEX label_frame" in plan[0][3]


def test_a_file_locked_by_another_program_is_not_treated_as_invalid(tmp_path):
    """Neither when it is replaced nor when it is read.

    After the lock is released, it can be used.
    """
    path = tmp_path / "labels.sqlite"
    SqliteExporter().write(path, toy_labels())
    with closing(sqlite3.connect(path, isolation_level=None, timeout=0)) as other:
        other.execute("BEGIN EXCLUSIVE")
        for look in (lambda: SqliteExporter().write(path, toy_labels()), lambda: read_frames(path)):
            with pytest.raises(DataError, match="another program is writing to this file"):
                look()
        other.execute("ROLLBACK")
    SqliteExporter().write(path, toy_labels())


VISIBILITY = (
    Column("visible_faces", "int32", "1", "faces of the box that the LiDAR sees", optional=True),
    Column("density", "float64", "1/m2", "points per square metre\n of the nearest face"),
)


def test_further_evidence_follows_the_core_columns(tmp_path):
    """Table, view and version depend on the columns; what a training reads does not change."""
    path = tmp_path / "labels.sqlite"
    rows = [label("b", visible_faces=2, density=1.5), label("c", visible_faces=None, density=0.0)]
    assert write(path, labels=rows, columns=(*WEIGHTED_LABELS, *VISIBILITY)) == 2
    with closing(sqlite3.connect(path)) as connection:
        cursor = connection.execute("SELECT * FROM weighted_labels ORDER BY frame")
        names = [column[0] for column in cursor.description]
        assert [dict(zip(names, row, strict=True)) for row in cursor] == rows
    assert names[-3:] == ["weight", "visible_faces", "density"]
    assert select(path, "SELECT value FROM meta WHERE key = 'format_version'") == [("2",)]
    assert len(WeightedLabels(path, read=toy_frame)) == 3


@pytest.mark.parametrize("value", ["many", None])
def test_further_evidence_that_does_not_fit_is_rejected(tmp_path, value):
    """Text for a number, or null in a declared column."""
    rows = [label("b", visible_faces=2, density=value)]
    with pytest.raises(
        DataError, match=r"labels\.sqlite: a row violates a constraint: .*label.density"
    ):
        write(tmp_path / "labels.sqlite", labels=rows, columns=(*WEIGHTED_LABELS, *VISIBILITY))


@pytest.mark.parametrize(
    "column", ["density BLOB AS (zeroblob(1000000))", "density REAL DEFAULT 1", '"a b" REAL']
)
def test_only_plain_columns_can_follow_the_core_ones(tmp_path, column):
    """Anything else in the table was not written by an export."""
    path = tmp_path / "labels.sqlite"
    write(path)
    with closing(sqlite3.connect(path)) as connection:
        [(made,)] = connection.execute("SELECT sql FROM sqlite_master WHERE name = 'label'")
        connection.executescript(
            "DROP VIEW weighted_labels; DROP TABLE label;"
            + made.replace("    split TEXT", f"    {column},\n    split TEXT")
        )
    with pytest.raises(DataError, match="table label differs from that of an export"):
        read_frames(path)


# As curate 1 wrote it before any format had further columns.
VERSION_1 = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
CREATE TABLE frame (
    frame TEXT PRIMARY KEY,
    split TEXT NOT NULL CHECK (split IN ('labeled', 'unlabeled')),
    points TEXT NOT NULL,       -- paths below meta.root
    image TEXT,
    calibration TEXT NOT NULL,
    UNIQUE (frame, split)
) STRICT;
CREATE TABLE ground_truth (
    frame TEXT NOT NULL,
    k INTEGER NOT NULL,
    category TEXT NOT NULL,
    x REAL NOT NULL, y REAL NOT NULL, z REAL NOT NULL,  -- box centre, metres, LiDAR frame
    length REAL NOT NULL CHECK (length > 0),
    width REAL NOT NULL CHECK (width > 0),
    height REAL NOT NULL CHECK (height > 0),
    yaw REAL NOT NULL,          -- radians, counter-clockwise from x
    truncated REAL NOT NULL,    -- share outside the image
    occluded INTEGER NOT NULL,  -- KITTI's levels 0 to 3
    split TEXT GENERATED ALWAYS AS ('labeled') VIRTUAL,
    FOREIGN KEY (frame, split) REFERENCES frame (frame, split)
) STRICT;
CREATE TABLE label (
    round INTEGER NOT NULL,
    frame TEXT NOT NULL,
    k INTEGER NOT NULL,
    category TEXT NOT NULL,
    x REAL NOT NULL, y REAL NOT NULL, z REAL NOT NULL,  -- box centre, metres, LiDAR frame
    length REAL NOT NULL CHECK (length > 0),
    width REAL NOT NULL CHECK (width > 0),
    height REAL NOT NULL CHECK (height > 0),
    yaw REAL NOT NULL,          -- radians, counter-clockwise from x
    score REAL NOT NULL,
    loss REAL,                  -- consistency loss L; NULL without a matched reprediction
    points INTEGER,             -- LiDAR points in the box
    points_threshold REAL,      -- m_th of the category
    rho_diff REAL,              -- Eq. 8
    mask_pixels INTEGER,        -- S, pixels of the category in the rectangle
    box_pixels INTEGER,         -- A, pixels of the rectangle
    rho_anno REAL,              -- Eq. 9
    rho_det REAL,               -- rho_diff * rho_anno
    lambda_u REAL,              -- age parameter, Eq. 4
    provenance TEXT NOT NULL CHECK (provenance IN ('detector', 'human')),
    policy TEXT NOT NULL,
    weight REAL NOT NULL CHECK (weight BETWEEN 0 AND 1),  -- v; 0: no object to learn
    split TEXT GENERATED ALWAYS AS ('unlabeled') VIRTUAL,
    FOREIGN KEY (frame, split) REFERENCES frame (frame, split)
) STRICT;
INSERT INTO meta VALUES ('format_version', '1'), ('dataset', 'kitti'), ('root', '/data/kitti'),
    ('categories', '["Car", "Cyclist"]'), ('round', '2'), ('policy', 'pspsl'),
    ('code_version', '1');
INSERT INTO frame VALUES ('a', 'labeled', 'velodyne/a.bin', 'image_2/a.png', 'calib/a.txt'),
    ('b', 'unlabeled', 'velodyne/b.bin', 'image_2/b.png', 'calib/b.txt');
INSERT INTO ground_truth VALUES ('a', 0, 'Car', 10.0, 1.0, -0.8, 4.0, 1.6, 1.5, 0.5, 0.0, 0);
INSERT INTO label VALUES
    (2, 'b', 0, 'Car', 10.0, 1.0, -0.8, 4.0, 1.6, 1.5, 0.5, 0.9, 0.2, 30, 60.0, 0.5, 80, 100, 0.8,
     0.4, 1.5, 'detector', 'pspsl', 0.5),
    (2, 'b', 1, 'Car', 20.0, 1.0, -0.8, 4.0, 1.6, 1.5, 0.5, 0.4, NULL, 3, 60.0, 0.05, 8, 100, 0.1,
     0.01, 1.5, 'detector', 'pspsl', 0.0);
CREATE VIEW weighted_labels AS SELECT round, frame, k, category, x, y, z, length, width, height,
    yaw, score, loss, points, points_threshold, rho_diff, mask_pixels, box_pixels, rho_anno,
    rho_det, lambda_u, provenance, policy, weight FROM label;
CREATE UNIQUE INDEX ground_truth_frame ON ground_truth (frame, k);
CREATE UNIQUE INDEX label_frame ON label (frame, k, round, policy);
ANALYZE;
"""


def test_a_file_of_version_1_can_still_be_read(tmp_path):
    """By the firewall, a training and a query; its weight 0 means ignored."""
    path = tmp_path / "labels.sqlite"
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(VERSION_1)
    found = read_frames(path)
    assert (found.splits, found.objects, found.labels) == ({"a": "labeled", "b": "unlabeled"}, 1, 2)
    labels = WeightedLabels(path, read=toy_frame)
    assert labels.zero_weight == "ignore"
    assert labels[1].weights.tolist() == [0.5, 0.0]
    assert labels[1].ignored.tolist() == [False, True]
    names, rows = run_query(
        URL.create("sqlite", database=str(path)), "SELECT * FROM weighted_labels"
    )
    assert dict(zip(names, next(rows), strict=True)) == label("b")
    write(path, labels=[label("b")])
    assert select(path, "SELECT count(*) FROM label") == [(1,)]
