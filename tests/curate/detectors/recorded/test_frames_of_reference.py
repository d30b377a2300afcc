"""One property for every recorded format: boxes written in it are read back unchanged.

The writers do not use curate's conversions: they transform with scipy's rotations.
"""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from oracles.camera_boxes import in_camera, mmdetection3d_boxes, openpcdet_boxes
from scipy.spatial.transform import Rotation
from support.recorded_formats import FRAME, WRITERS, assert_equal, write_result_file
from support.rigs import Rig, assert_equal_boxes, detections, rigs
from support.strategies import similarities

from curate.detections import Detections, as_categories
from curate.detectors.recorded import RecordedDetector
from curate.detectors.recorded.formats import KINDS
from curate.errors import ConfigError, DataError
from curate.geometry.similarity import Similarity


def test_every_format_has_a_writer() -> None:
    assert {kind.split()[0] for kind in WRITERS} == set(KINDS)


@pytest.mark.parametrize("kind", WRITERS)
@settings(max_examples=15, deadline=None)
@given(found=detections, rig=rigs)
def test_boxes_are_read_back_unchanged(kind: str, found: Detections, rig: Rig) -> None:
    """Whatever frame of reference, origin, order of sizes and angle the format has."""
    with tempfile.TemporaryDirectory() as folder:
        path, options = WRITERS[kind](Path(folder) / "results", found, rig)
        record = RecordedDetector(path, **options)
        assert_equal(record.predict(rig.frame(FRAME)), found)


@pytest.mark.parametrize("kind", [kind for kind in WRITERS if kind not in ("csv", "parquet")])
@settings(max_examples=8, deadline=None)
@given(found=detections, rig=rigs, similarity=similarities.filter(lambda a: a != Similarity()))
def test_boxes_of_an_augmented_copy_are_read_back(
    kind: str, found: Detections, rig: Rig, similarity: Similarity
) -> None:
    """A second pass is written with the same sensors, and inverted afterwards."""
    # Scales from 0.1 to 10 move boxes beyond the accepted range.
    similarity = Similarity(similarity.flip_y, similarity.rotation_rad, 1.0)
    if similarity == Similarity():
        similarity = Similarity(flip_y=True)
    moved = Detections(similarity.apply_to_boxes(found.boxes), found.scores, found.categories)
    with tempfile.TemporaryDirectory() as folder:
        path, options = WRITERS[kind](Path(folder) / "results", found, rig)
        second, _ = WRITERS[kind](Path(folder) / "second", moved, rig)
        one = {"path": second.name, "flip_y": similarity.flip_y}
        one["rotation_rad"] = similarity.rotation_rad
        record = RecordedDetector(
            path, passes=[one], calibration=lambda _: rig.calibration, **options
        )
        [(told, seen)] = record.views(FRAME)
        back = Detections(told.invert_boxes(seen.boxes), seen.scores, seen.categories)
        assert_equal(back, found)


@pytest.mark.parametrize("kind", ["csv", "openpcdet", "mmdetection3d"])
def test_boxes_in_the_axes_of_nuscenes_sensor_are_read_back(kind: str, tmp_path: Path) -> None:
    """There x is to the right and y forward; camera and map coordinates do not change."""
    boxes = np.array([[12.0, 3.0, -0.8, 4.0, 1.8, 1.5, 0.3], [9.0, -4.0, 0.1, 1.0, 0.8, 1.7, 3.1]])
    found = Detections(boxes, np.array([0.9, 0.5]), as_categories(["Car", "Pedestrian"]))
    quarter = Rotation.from_euler("z", 90, degrees=True)
    there = np.column_stack([quarter.apply(boxes[:, :3]), boxes[:, 3:6], boxes[:, 6] + np.pi / 2])
    rig = Rig()
    written = Detections(there, found.scores, found.categories)
    path, options = WRITERS[kind](tmp_path / "results", written, rig)
    record = RecordedDetector(path, axes="right-forward", **options)
    assert_equal(record.predict(rig.frame(FRAME)), found)
    with pytest.raises(ConfigError, match="axes 'up': use one of forward-left, right-forward"):
        RecordedDetector(path, axes="up", **options)


@pytest.mark.parametrize("writer", ["openpcdet", "mmdetection3d", "view-of-delft"])
@settings(max_examples=15)
@given(found=detections, rig=rigs)
def test_results_by_the_formula_of_other_frameworks_are_read_back(
    writer: str, found: Detections, rig: Rig
) -> None:
    """They write rotation_y = -yaw - pi/2 whatever the calibration says, and declare it."""
    bottoms, _ = in_camera(found.boxes, rig.turn, np.array(rig.origin), 0, upside_down=False)
    rotations_y = -found.boxes[:, 6] - np.pi / 2
    # The formulas, to be sure that these files are those of the frameworks.
    lengths_first = found.boxes[:, [3, 5, 4]]
    matrix = rig.calibration.lidar_to_camera
    assert_equal_boxes(openpcdet_boxes(bottoms, lengths_first, rotations_y, matrix), found.boxes)
    standing = found.boxes - np.outer(found.boxes[:, 5] / 2, [0, 0, 1, 0, 0, 0, 0])
    camera_boxes = np.column_stack([bottoms, lengths_first, rotations_y])
    assert_equal_boxes(mmdetection3d_boxes(camera_boxes, matrix), standing)
    with tempfile.TemporaryDirectory() as folder:
        write_result_file(Path(folder) / "results", found, bottoms, rotations_y)
        record = RecordedDetector(Path(folder) / "results", rotation_y=writer)
        assert_equal(record.predict(rig.frame(FRAME)), found)


def test_an_unknown_meaning_of_rotation_y_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"use one of calibration, .*; did you mean 'openpcdet'"):
        RecordedDetector(tmp_path, rotation_y="OpenPCDet ")


def test_results_of_a_camera_on_its_side_are_rejected(tmp_path: Path) -> None:
    """Its rotation_y is not a heading; the message contains file and frame."""
    rig = Rig(roll=np.pi / 2)
    found = Detections(np.ones((1, 7)), np.ones(1), as_categories(["Car"]))
    path, _ = WRITERS["kitti"](tmp_path / "results", found, rig)
    with pytest.raises(DataError, match=r"results: frame 000001: the camera's y axis is 0\.0 deg"):
        RecordedDetector(path).predict(rig.frame(FRAME))
