"""The 3D recording, read back with rerun's own reader."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from curate.errors import ConfigError
from curate.frames import Calibration, Frame
from curate.viewing import recording
from curate.viewing.palette import DARK, weight_colours
from curate.viewing.recording import (
    CAMERA,
    POINTS,
    PREDICTIONS,
    REPREDICTIONS,
    TRUTH,
    RecordedFrame,
    camera_pose,
    captions,
    write_recording,
)
from curate.viewing.tags import ShownLabels, ShownRepredictions

CALIBRATION = Calibration(
    np.array([[60.0, 0, 60, 12], [0, 62, 20, -3], [0, 0, 1, 0.01]]),
    np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]]),
)
BOXES = np.array([[10.0, 2, -0.8, 4, 1.8, 1.6, 0.5], [15.0, -3, -0.8, 0.8, 0.6, 1.7, -2.0]])
NOBODY = ShownLabels(np.zeros((0, 7)), np.zeros(0, np.str_), np.zeros(0), np.zeros(0))
NOTHING = ShownRepredictions(np.zeros((0, 7)), np.zeros(0))


def seen_frame(count: int, *, image: bool = True) -> Frame:
    """Return a frame with some points."""
    generator = np.random.default_rng(count)
    points = generator.uniform(-20, 20, (count, 4)).astype(np.float32)
    pixels = generator.integers(0, 255, (40, 120, 3), dtype=np.uint8) if image else None
    return Frame("000001", points, CALIBRATION, (120, 40), pixels)


@pytest.fixture
def full() -> RecordedFrame:
    """Return two labels, one of them ignored, one reprediction, ground truth with a DontCare."""
    labels = ShownLabels(
        BOXES, np.array(["Car", "Pedestrian"]), np.array([0.9, 0.2]), np.array([0.63, 0.0]),
        np.array([120, 3]),
    )  # fmt: skip
    truth = np.vstack([BOXES[:1], np.full((1, 7), np.nan)])
    return RecordedFrame(
        seen_frame(50),
        labels,
        {"loss": np.array([0.42, np.nan])},
        ShownRepredictions(BOXES[:1] + 0.1, np.array([0.63])),
        truth,
        np.array(["Car", "DontCare"]),
        "frame 000001",
    )


def read_back(path: Path) -> dict[str, list[dict]]:
    """Return the components of each entity, per row of the time line `frame`."""
    rerun = pytest.importorskip("rerun.chunk", reason="the extra [rerun] is not installed")
    found: dict[str, list[dict]] = {}
    for chunk in rerun.RrdReader(path).store().stream():
        for row in chunk.to_record_batch().to_pylist():
            content = {
                name.split(":")[-1]: value for name, value in row.items() if value is not None
            }
            found.setdefault(str(chunk.entity_path).strip("/"), []).append(content)
    return {
        place: sorted(rows, key=lambda row: row.get("frame", -1)) for place, rows in found.items()
    }


def test_a_recording_contains_points_boxes_weights_and_evidence(
    tmp_path: Path, full: RecordedFrame
) -> None:
    """Counts, positions, colours, captions and numbers are read from the file."""
    pytest.importorskip("rerun", reason="the extra [rerun] is not installed")
    assert write_recording(tmp_path / "a.rrd", iter([full])) == 1
    found = read_back(tmp_path / "a.rrd")
    [points] = found[POINTS]
    np.testing.assert_allclose(points["positions"], full.frame.points[:, :3])
    [boxes] = found[PREDICTIONS]
    np.testing.assert_allclose(boxes["centers"], BOXES[:, :3], atol=1e-6)
    np.testing.assert_allclose(boxes["half_sizes"], BOXES[:, 3:6] / 2, atol=1e-6)
    x, y, z, w = np.array(boxes["quaternions"]).T
    np.testing.assert_allclose((x, y), 0)
    np.testing.assert_allclose(2 * np.arctan2(z, w), BOXES[:, 6], atol=1e-6)
    assert boxes["colors"] == as_rgba(weight_colours(full.labels.weights))
    assert "weight 0.63" in boxes["labels"][0]
    assert "120 pts" in boxes["labels"][0]
    assert "loss 0.42" in boxes["labels"][0]
    assert "weight" not in boxes["labels"][1]
    assert boxes["weight"] == pytest.approx([0.63, 0])
    assert boxes["loss"][0] == pytest.approx(0.42)
    assert found[REPREDICTIONS][0]["colors"] == as_rgba(weight_colours(np.array([0.63])))
    [truth] = found[TRUTH]
    assert truth["labels"] == ["Car"]
    assert truth["colors"] == as_rgba(np.array([DARK.ground_truth], dtype=np.uint8))


def as_rgba(colours: np.ndarray) -> list[int]:
    """Return (n, 3) uint8 as rerun stores them: one number 0xRRGGBBAA each."""
    return [int.from_bytes([*colour.tolist(), 255], "big") for colour in colours]


def test_a_frame_without_labels_shows_none_of_the_previous_frame(
    tmp_path: Path, full: RecordedFrame
) -> None:
    """A viewer shows the latest value of each entity: missing ones must be cleared."""
    pytest.importorskip("rerun", reason="the extra [rerun] is not installed")
    bare = RecordedFrame(seen_frame(7), NOBODY, {"loss": np.zeros(0)}, NOTHING)
    assert write_recording(tmp_path / "a.rrd", iter([full, bare, full])) == 3
    found = read_back(tmp_path / "a.rrd")
    assert [row["frame"] for row in found[POINTS]] == [0, 1, 2]
    assert [len(row["positions"]) for row in found[POINTS]] == [50, 7, 50]
    assert [row.get("is_recursive") for row in found[PREDICTIONS]] == [None, [False], None]
    assert [len(row["centers"]) for row in found[TRUTH]] == [1, 0, 1]
    assert [len(row["centers"]) for row in found[REPREDICTIONS]] == [1, 0, 1]


def test_the_image_is_that_of_the_frame(tmp_path: Path, full: RecordedFrame) -> None:
    """As a JPEG at the camera; no camera if the frame was read without its image."""
    pytest.importorskip("rerun", reason="the extra [rerun] is not installed")
    write_recording(tmp_path / "a.rrd", iter([full]))
    [content] = read_back(tmp_path / "a.rrd")[f"{CAMERA}/image"]
    blob = np.frombuffer(bytes(content["blob"][0]), np.uint8)
    assert cv2.imdecode(blob, cv2.IMREAD_COLOR).shape == (40, 120, 3)
    blind = RecordedFrame(seen_frame(9, image=False), NOBODY, {}, NOTHING)
    write_recording(tmp_path / "b.rrd", iter([blind]))
    assert not any(place.startswith(CAMERA) for place in read_back(tmp_path / "b.rrd"))


def test_the_camera_pose_matches_its_projection() -> None:
    """K R^T (x - c) are the homogeneous pixels of x, up to their scale."""
    intrinsics, rotation, centre = camera_pose(CALIBRATION)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    places = np.random.default_rng(0).uniform([5, -5, -2], [40, 5, 2], (20, 3))
    found = (places - centre) @ rotation @ intrinsics.T
    expected = np.column_stack([places, np.ones(20)]) @ CALIBRATION.lidar_to_image.T
    np.testing.assert_allclose(found[:, :2] / found[:, 2:], expected[:, :2] / expected[:, 2:])
    assert (found[:, 2] > 0).all()


def test_a_caption_leaves_out_unknown_values(full: RecordedFrame) -> None:
    """NaN is not shown."""
    assert captions(full.labels, full.evidence) == [
        "k 0  weight 0.63\nCar 0.90  120 pts\nloss 0.42",
        "k 1\nPedestrian 0.20  3 pts",
    ]


def test_an_error_keeps_the_earlier_recording(tmp_path: Path, full: RecordedFrame) -> None:
    """The file is written completely or not at all."""
    pytest.importorskip("rerun", reason="the extra [rerun] is not installed")
    path = tmp_path / "a.rrd"
    path.write_bytes(b"former")

    def frames():
        yield full
        raise ConfigError("the second frame is damaged")

    with pytest.raises(ConfigError, match="second frame"):
        write_recording(path, frames())
    assert path.read_bytes() == b"former"
    assert list(tmp_path.iterdir()) == [path]


def test_without_rerun_the_extra_is_reported(
    tmp_path: Path, full: RecordedFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In one line, before anything is written."""
    monkeypatch.setitem(__import__("sys").modules, "rerun", None)
    with pytest.raises(ConfigError, match=r"pip install 'curate-pseudo-labels\[rerun\]'"):
        recording.write_recording(tmp_path / "a.rrd", iter([full]))
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_is_reported(tmp_path: Path, full: RecordedFrame) -> None:
    """It does not exist."""
    pytest.importorskip("rerun", reason="the extra [rerun] is not installed")
    with pytest.raises(ConfigError, match="a recording cannot be written there"):
        write_recording(tmp_path / "gone" / "a.rrd", iter([full]))
