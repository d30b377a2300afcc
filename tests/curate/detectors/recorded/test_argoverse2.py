"""Recorded detections of Argoverse 2 in Feather."""

import logging
from pathlib import Path

import numpy as np
import pytest
from support.toys import empty_frame

from curate.detectors.recorded import RecordedDetector
from curate.errors import ConfigError, DataError

arrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
feather = pytest.importorskip("pyarrow.feather", reason="pyarrow is not installed")

LOG, OTHER_LOG = "02678d04-cc9f-3148-9f95-1ba66347dff9", "02a00399-3857-444e-8db3-a8f58489c394"
# More digits than a float64 has, and one apart.
TIMES = (315966070559696000, 315966070559696001)
FRAMES = [f"{LOG}_{time}" for time in TIMES]


def table(**changes):
    """Return two boxes of the first sweep and one of the second, with some columns changed."""
    columns = {
        **{name: [float(i), 2.0, 3.0] for i, name in enumerate(("tx_m", "ty_m", "tz_m"))},
        **{key: [4.0, 1.0, 2.0] for key in ("length_m", "width_m", "height_m")},
        "qw": [np.cos(0.25), 1.0, 1.0],
        "qx": [0.0] * 3,
        "qy": [0.0] * 3,
        "qz": [np.sin(0.25), 0.0, 0.0],
        "score": [0.9, 0.2, 0.5],
        "log_id": [LOG] * 3,
        "timestamp_ns": [TIMES[0], TIMES[0], TIMES[1]],
        "category": ["REGULAR_VEHICLE", "PEDESTRIAN", "BUS"],
        "track_uuid": ["x"] * 3,
    } | changes
    return arrow.table({name: values for name, values in columns.items() if values is not None})


def write(path: Path, **changes) -> Path:
    """Write the table as Feather."""
    feather.write_feather(table(**changes), path)
    return path


def test_a_sweep_is_a_frame(tmp_path):
    """Boxes are in the frame of the points; the time keeps all its digits."""
    record = RecordedDetector(write(tmp_path / "a.feather"), frame_ids=FRAMES)
    assert record.frame_ids() == tuple(FRAMES)
    found = record.predict(empty_frame(FRAMES[0]))
    np.testing.assert_allclose(found.boxes[0], [0, 1, 2, 4, 4, 4, 0.5])
    assert found.categories.tolist() == ["REGULAR_VEHICLE", "PEDESTRIAN"]
    assert found.scores.tolist() == [0.9, 0.2]
    assert len(record.predict(empty_frame(FRAMES[1]))) == 1


def test_frames_can_be_named_by_the_time_alone(tmp_path):
    """The data set's names decide."""
    path = write(tmp_path / "a.feather")
    record = RecordedDetector(path, frame_ids=[str(TIMES[0])])
    assert len(record.predict(empty_frame(str(TIMES[0])))) == 2
    assert record.frame_ids() == tuple(map(str, TIMES))
    record = RecordedDetector(path, frame_name="{log_id}-{timestamp_ns}")
    assert record.frame_ids()[0] == f"{LOG}-{TIMES[0]}"


def test_the_same_time_in_two_logs_needs_the_log(tmp_path):
    """It would mix two frames."""
    path = write(tmp_path / "a.feather", log_id=[LOG, OTHER_LOG, LOG])
    with pytest.raises(ConfigError, match=f"two logs have a frame {TIMES[0]}; add .log_id. to"):
        RecordedDetector(path, frame_ids=[str(TIMES[0])])
    assert len(RecordedDetector(path).frame_ids()) == 3


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("{log}", "use {log_id} and {timestamp_ns}"),
        ("{log_id", "use {log_id} and {timestamp_ns}"),
        ("{log_id.real.x}", "use {log_id} and {timestamp_ns}"),
        ("{log_id}", "must contain {timestamp_ns}"),
    ],
)
def test_an_invalid_pattern_is_rejected(tmp_path, pattern, message):
    """Before the file is read."""
    with pytest.raises(ConfigError, match=message):
        RecordedDetector(tmp_path / "a.feather", frame_name=pattern)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"score": None, "qw": None}, "no column score, qw; it has tx_m, ty_m"),
        ({"tx_m": ["1", "2", "3"]}, "column tx_m is of type string, expected numbers"),
        ({"timestamp_ns": [1, None, 2]}, "record batch 0: no timestamp_ns in 1 of 3 rows"),
        ({"qw": [0.1, 1.0, 1.0]}, f"{FRAMES[0]}: box 0: rotation .* is not a unit quaternion"),
        ({"qw": [np.nan, 1.0, 1.0]}, "box 0: rotation .* is not a unit quaternion"),
        (
            {"qw": [0.0, 1.0, 1.0], "qx": [1.0, 0.0, 0.0], "qz": [0.0] * 3},
            "box 0 would be tilted by 180 degrees",
        ),
        ({"length_m": [0.0, 1.0, 1.0]}, "box 0: length, width or height is not positive"),
        ({"score": [-4.0, 0.2, 0.5]}, "scores from -4 to 0.5 are not in"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_a_record_is_rejected(tmp_path, changes, message):
    """When it is opened, in one line with the file."""
    path = write(tmp_path / "a.feather", **changes)
    with pytest.raises(DataError, match=message) as caught:
        RecordedDetector(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_damaged_file_is_rejected(tmp_path):
    """Truncated, or not Feather at all."""
    path = write(tmp_path / "a.feather")
    content = path.read_bytes()
    for damaged in (content[:-30], b"", content[: len(content) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(DataError, match="not a readable Feather file"):
            RecordedDetector(path)


def test_sweeps_that_the_data_set_lacks_are_reported(tmp_path, caplog):
    """As for every format."""
    with caplog.at_level(logging.WARNING):
        RecordedDetector(write(tmp_path / "a.feather"), frame_ids=FRAMES[:1])
    assert "1 of 2 results are for frames that the data set does not have" in caplog.text
