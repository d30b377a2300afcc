"""The detector that reads its predictions from a file."""

import pickle

import numpy as np
import pytest
from support.toys import empty_frame

from curate.detectors.base import RecordedViews
from curate.detectors.recorded import RecordedDetector
from curate.detectors.recorded.table import BLOCK_ROWS
from curate.errors import DataError
from curate.geometry.similarity import Similarity

HEADER = "frame,view,flip_y,rotation_rad,scale,category,score,merged,x,y,z,length,width,height,yaw"
BOX = "12.0,4.2,-0.8,3.9,1.6,1.5,-3.0"
PLAIN = f"000001,0,0,0.0,1.0,Car,0.9,64,{BOX}"
MOVED = f"000001,1,1,0.25,1.04,Car,0.8,3,{BOX}"


def write(path, *rows, header=HEADER):
    """Write a record with a header."""
    path.write_text("".join(f"{row}\n" for row in (header, *rows)))
    return path


def test_it_returns_what_was_recorded(tmp_path):
    """View 0 is the prediction, the others are augmented copies with their similarity."""
    detector = RecordedDetector(write(tmp_path / "a.csv", PLAIN, MOVED))
    found = detector.predict(empty_frame("000001"))
    assert found.boxes.tolist() == [[12.0, 4.2, -0.8, 3.9, 1.6, 1.5, -3.0]]
    assert found.scores.tolist() == [0.9]
    assert found.categories.tolist() == ["Car"]
    [(similarity, moved)] = detector.views("000001")
    assert similarity == Similarity(flip_y=True, rotation_rad=0.25, scale=1.04)
    assert moved.scores.tolist() == [0.8]
    assert isinstance(detector, RecordedViews)


def test_the_names_of_all_rows_are_known(tmp_path):
    """Those of augmented copies too."""
    van = MOVED.replace("Car", "Van")
    record = RecordedDetector(write(tmp_path / "a.csv", PLAIN, van))
    assert record.category_names() == {"Car", "Van"}


def test_a_byte_order_mark_is_ignored(tmp_path):
    """The first column keeps its name."""
    path = write(tmp_path / "a.csv", PLAIN, MOVED)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    detector = RecordedDetector(path)
    assert detector.predict(empty_frame("000001")).scores.tolist() == [0.9]
    assert detector.views("000001")[0][1].scores.tolist() == [0.8]


def test_low_scores_are_dropped_in_every_view(tmp_path):
    """`minimum_score` itself is kept."""
    low = PLAIN.replace("0.9", "0.1")
    path = write(tmp_path / "a.csv", PLAIN, low, MOVED, MOVED.replace("0.8", "0.09"))
    detector = RecordedDetector(path, minimum_score=0.1)
    assert detector.predict(empty_frame("000001")).scores.tolist() == [0.9, 0.1]
    assert detector.views("000001")[0][1].scores.tolist() == [0.8]
    assert len(RecordedDetector(path, minimum_score=0.95).predict(empty_frame("000001"))) == 0


def test_a_row_that_occurs_twice_is_rejected(tmp_path):
    """A file appended to itself would double every label; rows that differ in a value are kept."""
    other = PLAIN.replace("000001", "000002")
    alike = [
        PLAIN.replace("Car", "Cyclist"),
        PLAIN.replace("0.9", "0.8"),
        PLAIN.replace("12.0", "9"),
    ]
    path = write(tmp_path / "a.csv", PLAIN, MOVED, other, *alike)
    assert len(RecordedDetector(path).predict(empty_frame("000001"))) == 4
    path.write_text(path.read_text() + f"{other.replace('0.9,', ' 0.90,')}\n{MOVED}\n")
    with pytest.raises(DataError, match=r"a\.csv:8: the same row as line 4; .* written twice"):
        RecordedDetector(path)


def test_a_long_file_that_was_appended_to_itself_is_rejected(tmp_path):
    """The frames of its two halves are not divided into the same blocks of rows."""
    rows = [
        PLAIN.replace("000001", f"{frame:06d}").replace("12.0", f"{k}.5")
        for frame in range(75)
        for k in range(60)
    ]
    assert len(rows) > BLOCK_ROWS
    path = write(tmp_path / "a.csv", *rows)
    assert len(RecordedDetector(path).predict(empty_frame("000068"))) == 60
    path = write(tmp_path / "b.csv", *rows, *rows)
    with pytest.raises(DataError, match=r"b\.csv:4502: the same row as line 2; .* written twice"):
        RecordedDetector(path)


def test_views_are_sorted_by_their_numbers(tmp_path):
    """Rows of frames and views can be mixed; there can be several views."""
    second = MOVED.replace("000001,1", "000001,2").replace("0.25", "-0.5")
    other = PLAIN.replace("000001", "000002")
    beside = second.replace("12.0", "22.0")
    detector = RecordedDetector(write(tmp_path / "a.csv", second, other, MOVED, PLAIN, beside))
    views = detector.views("000001")
    assert [similarity.rotation_rad for similarity, _ in views] == [0.25, -0.5]
    assert [len(found) for _, found in views] == [1, 2]
    assert detector.frame_ids() == ("000001", "000002")
    assert list(detector.views("000002")) == []


def test_a_frame_with_only_other_views_has_no_detections(tmp_path):
    """It was recorded, and the detector found nothing in it."""
    detector = RecordedDetector(write(tmp_path / "a.csv", MOVED))
    assert detector.predict(empty_frame("000001")).boxes.shape == (0, 7)


@pytest.mark.parametrize("rows", [(), (PLAIN,)])
def test_a_frame_that_was_never_recorded_is_an_error(tmp_path, rows):
    """It becomes a failed frame instead of an empty one."""
    path = write(tmp_path / "a.csv", *rows)
    detector = RecordedDetector(path)
    message = f"no recorded detections for frame 000007 in {path}"
    with pytest.raises(DataError) as caught:
        detector.predict(empty_frame("000007"))
    assert str(caught.value) == message
    with pytest.raises(DataError) as caught:
        detector.views("000007")
    assert str(caught.value) == message


def test_other_columns_and_their_order_do_not_matter(tmp_path):
    """Columns are found by name; `merged` is optional."""
    header = "yaw,height,width,length,z,y,x,score,category,scale,rotation_rad,flip_y,view,frame"
    row = "4.0,1.5,1.6,3.9,-0.8,4.2,12.0,0.9,Car,1,0,0,0,000001"
    detector = RecordedDetector(write(tmp_path / "a.csv", row, header=header))
    box = detector.predict(empty_frame("000001")).boxes[0]
    assert box[:6].tolist() == [12.0, 4.2, -0.8, 3.9, 1.6, 1.5]
    assert box[6] == pytest.approx(4.0 - 2 * np.pi)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (PLAIN.rsplit(",", 1)[0], "14 fields, the header has 15"),
        (f"{PLAIN},1", "16 fields, the header has 15"),
        (PLAIN.replace("12.0", "far"), "'far' is not a number"),
        (PLAIN.replace("12.0", "nan"), "a number is NaN or infinite"),
        (PLAIN.replace("0.9", "inf"), "a number is NaN or infinite"),
        (PLAIN.replace("0.9", "1.2"), "scores up to 1.2 are not in [0, 1]"),
        (PLAIN.replace("0.9", "-0.1"), "scores from -0.1 to 0.9 are not in [0, 1]"),
        (PLAIN.replace("1.6,1.5", "1.6,-1.5"), "length, width or height is not positive"),
        (PLAIN.replace("000001,0", "000001,0.5"), "view is not 0, 1, 2, ..."),
        (PLAIN.replace("000001,0", "000001,-1"), "view is not 0, 1, 2, ..."),
        (MOVED.replace("1,1,0.25", "1,2,0.25"), "flip_y is neither 0 nor 1"),
        (MOVED.replace("1.04", "0"), "scale is not positive"),
        (PLAIN.replace("0.0,1.0", "0.3,1.0"), "view 0 is the original frame"),
        (MOVED.replace("0.25", "0.26"), "differ from line 3, which is of the same frame and view"),
    ],
)
def test_an_invalid_row_gives_one_line_with_its_position(tmp_path, row, message):
    """The error contains file, line and reason."""
    path = write(tmp_path / "a.csv", PLAIN, MOVED, row)
    with pytest.raises(DataError) as caught:
        RecordedDetector(path)
    assert str(caught.value).startswith(f"{path}:4: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_columns_of_views_are_optional(tmp_path):
    """As in Parquet: every row then belongs to the original frame. All four, or none."""
    header = "frame,category,score,x,y,z,length,width,height,yaw"
    path = write(tmp_path / "a.csv", f"000001,Car,0.9,{BOX}", header=header)
    detector = RecordedDetector(path)
    assert detector.predict(empty_frame("000001")).boxes.tolist() == [
        [12.0, 4.2, -0.8, 3.9, 1.6, 1.5, -3.0]
    ]
    assert detector.views("000001") == []
    write(path, f"000001,0,Car,0.9,{BOX}", header=header.replace(",", ",view,", 1))
    with pytest.raises(DataError, match=r"a\.csv:1: no column flip_y, rotation_rad, scale"):
        RecordedDetector(path)


def test_missing_columns_and_files_are_reported(tmp_path):
    """An empty file has no columns at all."""
    path = write(tmp_path / "a.csv", header=HEADER.replace("score,", "").replace(",yaw", ""))
    with pytest.raises(DataError, match=r"a\.csv:1: no column score, yaw in the header"):
        RecordedDetector(path)
    path.write_text("")
    with pytest.raises(DataError, match=r"a\.csv:1: no column frame, category, score,"):
        RecordedDetector(path)
    with pytest.raises(DataError, match=r"b\.csv: no such file of recorded detections"):
        RecordedDetector(tmp_path / "b.csv")
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match=r"a\.csv: saved as UTF-16"):
        RecordedDetector(path)


def test_it_can_be_sent_to_workers(tmp_path):
    """After pickling it returns the same."""
    detector = RecordedDetector(write(tmp_path / "a.csv", PLAIN, MOVED))
    copy = pickle.loads(pickle.dumps(detector))
    np.testing.assert_array_equal(
        copy.predict(empty_frame("000001")).boxes, detector.predict(empty_frame("000001")).boxes
    )


def test_real_records(kitti_root):
    """Both teachers have detections for all 24 frames and one augmented copy of each."""
    for name in ("pointgnn_T0.csv", "pointgnn_T1.csv"):
        detector = RecordedDetector(kitti_root / "recorded" / name)
        assert len(detector.frame_ids()) == 24
        views = [detector.views(frame_id) for frame_id in detector.frame_ids()]
        assert [len(view) for view in views] == [1] * 24


def test_real_views_match_the_frame_after_the_inverse(kitti_root):
    """Confident detections in A(x), transformed by A^-1, match those in x."""
    from curate.geometry.overlap import bev_iou

    detector = RecordedDetector(kitti_root / "recorded" / "pointgnn_T1.csv", minimum_score=0.9)
    sure = close = 0
    for frame_id in detector.frame_ids():
        found = detector.predict(empty_frame(frame_id))
        [(similarity, moved)] = detector.views(frame_id)
        if len(found) and len(moved):
            best = bev_iou(found.boxes, similarity.invert_boxes(moved.boxes)).max(axis=1)
            sure, close = sure + len(best), close + int((best > 0.6).sum())
    assert sure > 20
    assert close > 0.8 * sure
