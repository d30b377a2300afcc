"""Results of written copies, in every recorded format, are read back by the manifest."""

import pickle
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.camera_boxes import projected_rotations_y
from oracles.openpcdet_kitti import Calibration as OpenPCDetCalibration
from oracles.openpcdet_kitti import write_results
from scipy.spatial.transform import Rotation
from support.recorded_formats import FRAME, WRITERS, assert_equal, write_result_file
from support.rigs import FORWARD, Rig, detections, rigs

from curate.datasets.kitti.calibration import write_calibration
from curate.datasets.manifest import Manifest, view_folder
from curate.detections import Detections, as_categories
from curate.detectors.recorded import RecordedDetector
from curate.errors import ConfigError, DataError
from curate.geometry.augmented_views import AugmentedViews, augmented_calibration
from curate.geometry.similarity import Similarity

similarities = st.builds(
    Similarity, st.booleans(), st.floats(-np.pi / 4, np.pi / 4), st.floats(0.95, 1.05)
)  # fmt: skip
EIGHTH = (Similarity(False, np.pi / 4, 1.05), Similarity(True, -np.pi / 4, 0.95))


def write_manifest(folder: Path, views: tuple[Similarity, ...], **more) -> Manifest:
    """Write the manifest of copies of one frame, and the folders of its views."""
    drawn = AugmentedViews(views=len(views))
    values = {"rotation_y": "openpcdet", "frames": {FRAME: views}} | more
    manifest = Manifest("unlabeled", drawn, False, "kitti", {"000000": "x"}, "kitti", **values)
    manifest.write(folder)
    for view in range(len(views)):
        view_folder(view, folder).mkdir()
    return manifest


def moved(found: Detections, similarity: Similarity) -> Detections:
    """Return detections of a copy."""
    return Detections(similarity.apply_to_boxes(found.boxes), found.scores, found.categories)


def assert_read_back(record: RecordedDetector, views, found: Detections) -> None:
    """Check that every view has its A, and the detections after A^-1."""
    read = record.views(FRAME)
    assert [similarity for similarity, _ in read] == list(views)
    for similarity, seen in read:
        boxes = similarity.invert_boxes(seen.boxes)
        assert_equal(Detections(boxes, seen.scores, seen.categories), found)


@pytest.mark.parametrize("kind", [kind for kind in WRITERS if kind != "kitti"])
@settings(max_examples=6, deadline=None)
@given(found=detections, rig=rigs, views=st.tuples(similarities, similarities))
def test_boxes_of_written_copies_are_read_back(
    kind: str, found: Detections, rig: Rig, views: tuple[Similarity, Similarity]
) -> None:
    """Formats in the frame of the points, and in the map, which keeps the pose of the sweep."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path, options = WRITERS[kind](folder / "plain", found, rig)
        write_manifest(folder / "copies", views)
        for view, similarity in enumerate(views):
            home = view_folder(view, folder / "copies")
            WRITERS[kind](home / "results", moved(found, similarity), rig)
        record = RecordedDetector(
            path, augmented=folder / "copies", calibration=lambda _: rig.calibration, **options
        )
        assert_read_back(record, views, found)
        assert_equal(record.predict(rig.frame(FRAME)), found)


@settings(max_examples=20, deadline=None)
@given(found=detections, rig=rigs, views=st.tuples(similarities, similarities))
def test_result_files_of_a_tool_in_the_cameras_frame(
    found: Detections, rig: Rig, views: tuple[Similarity, Similarity]
) -> None:
    """It turns points by the calibration of the copy, and knows headings in the camera's plane."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_manifest(folder / "copies", views, rotation_y="nuscenes")
        for home, similarity in (
            (folder / "plain", Similarity()),
            *((view_folder(k, folder / "copies") / "results", a) for k, a in enumerate(views)),
        ):
            matrix = augmented_calibration(rig.calibration, similarity).lidar_to_camera
            boxes = similarity.apply_to_boxes(found.boxes)
            turn = Rotation.from_matrix(matrix[:3, :3])
            bottoms = turn.apply(boxes[:, :3] - np.outer(boxes[:, 5] / 2, [0, 0, 1]))
            rotations_y = projected_rotations_y(boxes, turn)
            write_result_file(home, moved(found, similarity), bottoms + matrix[:3, 3], rotations_y)
        record = RecordedDetector(
            folder / "plain",
            augmented=folder / "copies",
            calibration=lambda _: rig.calibration,
            rotation_y="nuscenes",
        )
        assert_read_back(record, views, found)


def write_as_openpcdet(folder: Path, found: Detections, views, rig: Rig = FORWARD) -> Path:
    """Write result files of a frame and of its copies by OpenPCDet's formulas."""
    plain = folder / "plain"
    for home, similarity in (
        (plain, Similarity()),
        *((view_folder(k, folder / "copies") / "results", a) for k, a in enumerate(views)),
    ):
        write_calibration(folder / "calib.txt", augmented_calibration(rig.calibration, similarity))
        boxes = similarity.apply_to_boxes(found.boxes)
        calibration = OpenPCDetCalibration(folder / "calib.txt")
        write_results(home / f"{FRAME}.txt", boxes, found.scores, found.categories, calibration)
    return plain


CARS = Detections(
    np.array([[14.0, -4, -1, 4.4, 1.9, 1.6, 0.3], [25.0, 6, -1, 4.1, 1.7, 1.5, -2.8]]),
    np.array([0.9, 0.4]),
    as_categories(["Car", "Car"]),
)


@pytest.mark.parametrize("views", [EIGHTH, EIGHTH[::-1], (Similarity(True, 0.0, 1.0), EIGHTH[1])])
def test_openpcdets_formula_on_copies_turned_by_45_degrees_and_flipped(
    tmp_path: Path, views: tuple[Similarity, Similarity]
) -> None:
    """The calibration's meaning of rotation_y would turn the headings by the turn of the copy."""
    write_manifest(tmp_path / "copies", views)
    plain = write_as_openpcdet(tmp_path, CARS, views)
    record = RecordedDetector(
        plain, augmented=tmp_path / "copies", calibration=lambda _: FORWARD.calibration
    )
    for view, similarity in enumerate(views):
        [(told, seen)] = record.views(FRAME)[view : view + 1]
        assert told == similarity
        back = similarity.invert_boxes(seen.boxes)
        np.testing.assert_allclose(back, CARS.boxes, atol=2e-3)  # four decimals
        other = record.found_in_copy(FRAME, view, "calibration").boxes[:, 6]
        turned = np.angle(np.exp(1j * (other - seen.boxes[:, 6])))
        np.testing.assert_allclose(np.abs(turned), abs(similarity.rotation_rad), atol=2e-3)


def test_a_declared_rotation_y_comes_before_that_of_the_manifest(tmp_path: Path) -> None:
    """It is the user's own statement."""
    write_manifest(tmp_path / "copies", EIGHTH, rotation_y="calibration")
    plain = write_as_openpcdet(tmp_path, CARS, EIGHTH)
    record = RecordedDetector(
        plain,
        augmented=tmp_path / "copies",
        rotation_y="openpcdet",
        calibration=lambda _: FORWARD.calibration,
    )
    for similarity, seen in record.views(FRAME):
        np.testing.assert_allclose(similarity.invert_boxes(seen.boxes), CARS.boxes, atol=2e-3)


def write_all(tmp_path: Path) -> Path:
    """Write OpenPCDet's pickles of a frame and of its copies; return that of the frame."""
    write_manifest(tmp_path / "copies", EIGHTH)
    for path, similarity in (
        (tmp_path / "plain.pkl", Similarity()),
        (tmp_path / "copies/view-1/result.pkl", EIGHTH[0]),
        (tmp_path / "copies/view-2/result.pkl", EIGHTH[1]),
    ):
        boxes = similarity.apply_to_boxes(CARS.boxes)
        entry = {"frame_id": FRAME, "name": CARS.categories, "score": CARS.scores}
        path.write_bytes(pickle.dumps([entry | {"boxes_lidar": boxes}]))
    return tmp_path / "plain.pkl"


def test_the_folder_of_mmdetection3ds_inferencer_is_found(tmp_path: Path) -> None:
    """It writes preds/FRAME.json below the folder that it is given."""
    plain = write_all(tmp_path)
    for view, similarity in enumerate(EIGHTH):
        home = view_folder(view, tmp_path / "copies")
        (home / "result.pkl").unlink()
        (home / "results/preds").mkdir(parents=True)
        boxes = similarity.apply_to_boxes(CARS.boxes)
        boxes[:, 2] -= boxes[:, 5] / 2
        (home / f"results/preds/{FRAME}.json").write_text(
            f'{{"bboxes_3d": {boxes.tolist()}, "scores_3d": [0.9, 0.4], "labels_3d": [0, 0], '
            '"box_type_3d": "LiDAR"}'
        )
    record = RecordedDetector(plain, augmented=tmp_path / "copies", classes=["Car"])
    assert_read_back(record, EIGHTH, CARS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: (f / "manifest.json").unlink(), r"manifest\.json: no such file; write the"),
        (lambda f: (f / "manifest.json").write_text("{}"), "not the manifest of `curate augment`"),
        (lambda f: (f / "view-2/result.pkl").unlink(), r"view-2: no results of the copies; run"),
        (lambda f: (f / "view-1/results").mkdir(), r"contains result\.pkl and results; remove"),
        (shutil.rmtree, "no such file; write the copies with `curate augment`"),
    ],
)
def test_what_is_missing_is_an_error_at_the_start(tmp_path: Path, change, message: str) -> None:
    """Before any frame is read, in one line."""
    plain = write_all(tmp_path)
    change(tmp_path / "copies")
    with pytest.raises(DataError, match=message):
        RecordedDetector(plain, augmented=tmp_path / "copies")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"version": 1', '"version": 2', "version 2, this curate reads 1"),
        ('"openpcdet"', '"sideways"', "damaged, copies.rotation_y 'sideways'"),
        ('"seed"', '"sed"', "damaged"),
        ('"scale": 1.05', '"scale": -1', "damaged, a similarity needs"),
        ('"views": 2', '"views": 3', "damaged, frames with another number of views"),
        ("}\n", "", "cannot be read as JSON"),
    ],
)
def test_a_damaged_manifest_is_rejected(tmp_path: Path, old: str, new: str, message: str) -> None:
    """With its path and what to do."""
    write_all(tmp_path)
    path = tmp_path / "copies/manifest.json"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(DataError, match=message) as raised:
        Manifest.read(tmp_path / "copies")
    assert "\n" not in str(raised.value)


def test_a_frame_without_copies_fails_alone(tmp_path: Path) -> None:
    """Such as one of another split."""
    record = RecordedDetector(write_all(tmp_path), augmented=tmp_path / "copies")
    with pytest.raises(DataError, match="no copies of frame 000007; these are copies of the split"):
        record.views("000007")
    assert record.lacks_copy("000007")
    assert not record.lacks_copy(FRAME)


def test_copies_and_passes_exclude_each_other(tmp_path: Path) -> None:
    """Both say what the second view of a frame is."""
    plain = write_all(tmp_path)
    one = [{"path": "plain.pkl", "flip_y": True}]
    with pytest.raises(ConfigError, match=r"passes and detector\.augmented are both set; remove"):
        RecordedDetector(plain, augmented=tmp_path / "copies", passes=one)


def test_the_manifest_is_the_same_after_reading(tmp_path: Path) -> None:
    """With every digit of every A."""
    manifest = write_manifest(tmp_path / "copies", (Similarity(True, 1 / 3, 0.1 + 0.2),))
    assert Manifest.read(tmp_path / "copies") == manifest
