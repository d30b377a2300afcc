"""The nuScenes reader on a tiny dataset with known geometry."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.nuscenes_scenes import (
    IMAGE_SIZE,
    MOUNTED,
    QUARTER,
    drawn_boxes,
    into_camera,
    sample_token,
    sweep_of,
    vehicle_pose,
    write_nuscenes,
)

from curate.datasets.base import sequences_of
from curate.datasets.frame_names import FrameNames
from curate.datasets.nuscenes import NuScenesDataset
from curate.errors import ConfigError, DataError
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.geometry.projection import project_points

SCENES = ("scene-0061", "scene-0103")
FRAMES = [(number, scene, step) for number, scene in enumerate(SCENES) for step in range(2)]


@pytest.fixture(scope="module")
def unchanged_root(tmp_path_factory) -> Path:
    """Return a folder that no test changes."""
    root = tmp_path_factory.mktemp("nuscenes")
    write_nuscenes(root)
    return root


@pytest.fixture
def root(tmp_path) -> Path:
    """Return a folder that a test can damage."""
    write_nuscenes(tmp_path)
    return tmp_path


def change(path: Path, edit) -> None:
    """Rewrite a table with edited records."""
    records = json.loads(path.read_text())
    for record in records:
        edit(record)
    path.write_text(json.dumps(records))


def test_boxes_are_transformed_from_the_map(unchanged_root):
    """Those in the camera's view, as they were placed in the LiDAR frame."""
    dataset = NuScenesDataset(unchanged_root)
    for number, scene, step in FRAMES:
        truth = dataset.annotations(sample_token(scene, step))
        expected = drawn_boxes(number, step)[:3]
        assert truth.categories.tolist() == ["Car", "Pedestrian", "Cyclist"]
        np.testing.assert_allclose(truth.boxes[:, :6], expected[:, :6], atol=1e-9)
        turn = np.angle(np.exp(1j * (truth.boxes[:, 6] - expected[:, 6])))
        np.testing.assert_allclose(turn, 0, atol=1e-9)
        assert truth.occluded.tolist() == [2, 1, 1]


def test_points_are_in_our_axes(unchanged_root):
    """Forward is x, left is y, intensity in [0, 1]; the boxes contain the objects' points."""
    dataset = NuScenesDataset(unchanged_root)
    for number, scene, step in FRAMES:
        boxes = drawn_boxes(number, step)
        frame = dataset.read(sample_token(scene, step))
        written = sweep_of(boxes, number * 100 + step)
        expected = QUARTER.inv().apply(written[:, :3])
        np.testing.assert_allclose(frame.points[:, :3], expected, atol=1e-5)
        np.testing.assert_allclose(frame.points[:, 3], written[:, 3] / 255, atol=1e-6)
        assert (count_points_in_boxes(frame.points, boxes) >= 30).all()


@pytest.mark.parametrize("camera", ["CAM_FRONT", "CAM_BACK"])
def test_points_are_projected_through_the_map(unchanged_root, camera):
    """The vehicle moves between the sweep and the image."""
    dataset = NuScenesDataset(unchanged_root, camera=camera)
    mounted = next(each for each in MOUNTED if each.channel == camera)
    for number, scene, step in FRAMES:
        frame = dataset.read(sample_token(scene, step), image=True)
        points = drawn_boxes(number, step)[:, :3]
        pixels, depth = project_points(points, frame.calibration)
        expected = into_camera(points, number, step, mounted)
        np.testing.assert_allclose(np.column_stack([pixels, depth]), expected, atol=1e-6)
        assert frame.image_size == IMAGE_SIZE


def test_the_camera_decides_which_objects_count(unchanged_root):
    """Only the back camera sees the object behind."""
    found = NuScenesDataset(unchanged_root, camera="CAM_BACK").annotations(
        sample_token(SCENES[0], 0)
    )
    np.testing.assert_allclose(found.boxes[:, :3], drawn_boxes(0, 0)[3:, :3], atol=1e-9)
    assert found.truncated.tolist() == pytest.approx([0.0], abs=1e-6)


def test_the_pose_of_the_lidar_is_read(unchanged_root):
    """Its origin in the map, and its x axis along the vehicle's."""
    calibration = (
        NuScenesDataset(unchanged_root).read(sample_token(SCENES[1], 1), points=False).calibration
    )
    pose, lidar = vehicle_pose(1, 1), MOUNTED[0]
    np.testing.assert_allclose(
        calibration.lidar_to_map[:3, 3], pose.place + pose.turn.apply(lidar.place)
    )
    expected = (pose.turn * lidar.turn * QUARTER).as_matrix()
    np.testing.assert_allclose(calibration.lidar_to_map[:3, :3], expected, atol=1e-12)
    ahead = pose.turn.inv().apply(calibration.lidar_to_map[:3, 0])
    assert ahead[0] > 0.99


def test_objects_without_points_are_left_out(unchanged_root):
    """By num_lidar_pts of the table."""
    found = NuScenesDataset(unchanged_root, minimum_points=29).annotations(
        sample_token(SCENES[0], 0)
    )
    assert found.categories.tolist() == ["Car", "Pedestrian"]


def test_other_class_names_can_be_requested(unchanged_root):
    """The task's own, for a detector that was trained on them."""
    dataset = NuScenesDataset(unchanged_root, rename={})
    found = dataset.annotations(sample_token(SCENES[0], 0))
    assert found.categories.tolist() == ["car", "pedestrian", "bicycle"]


def test_scenes_stay_whole(unchanged_root):
    """The official lists of v1.0-mini; other versions have none."""
    dataset = NuScenesDataset(unchanged_root)
    splits = dataset.splits()
    tokens = {scene: {sample_token(scene, step) for step in range(2)} for scene in SCENES}
    assert set(splits["train"]) == tokens["scene-0061"]
    assert set(splits["val"]) == tokens["scene-0103"]
    for scene, own in tokens.items():
        assert set(sequences_of(dataset, own).values()) == {scene}
    assert dataset.sequence_of("unknown") is None


def test_another_version_has_no_lists(tmp_path):
    write_nuscenes(tmp_path, version="v1.0-ours")
    assert NuScenesDataset(tmp_path).splits() == {}
    write_nuscenes(tmp_path / "full", version="v1.0-trainval", scenes=("scene-0001", "scene-0003"))
    lists = NuScenesDataset(tmp_path / "full").splits()
    assert set(lists["val"]) == {sample_token("scene-0003", step) for step in range(2)}


def test_key_frames_without_files_are_left_out(root):
    """The dataset is downloaded in parts."""
    first = sample_token(SCENES[0], 0)
    files = NuScenesDataset(root).files(first)
    files.image.unlink()
    assert first not in NuScenesDataset(root).frame_ids()
    assert len(NuScenesDataset(root).frame_ids()) == 3
    for path in (root / "samples" / "LIDAR_TOP").iterdir():
        path.unlink()
    with pytest.raises(DataError, match="4 of 4 key frames are missing, such as samples/LIDAR"):
        NuScenesDataset(root).frame_ids()


def test_the_version_and_the_camera_must_be_specified(root):
    """The error lists the available names."""
    with pytest.raises(ConfigError, match=r"camera 'CAM_TOP': use one of CAM_BACK, CAM_FRONT"):
        NuScenesDataset(root, camera="CAM_TOP").frame_ids()
    with pytest.raises(ConfigError, match=r"no version v1\.0-test; .* to one of v1\.0-mini"):
        NuScenesDataset(root, version="v1.0-test")
    (root / "v1.0-test").mkdir()
    (root / "v1.0-test" / "sample_data.json").write_text("[]")
    with pytest.raises(ConfigError, match=r"several versions; .* one of v1\.0-mini, v1\.0-test"):
        NuScenesDataset(root)
    assert len(NuScenesDataset(root, version="v1.0-mini").frame_ids()) == 4
    with pytest.raises(DataError, match=r"set the root to the folder with samples/ and v1\.0"):
        NuScenesDataset(root / "v1.0-mini")


@pytest.mark.parametrize(
    ("table", "edit", "message"),
    [
        ("ego_pose", {"rotation": [1, 1, 0, 0]}, "is not a unit quaternion"),
        ("ego_pose", {"translation": [1, None, 0]}, "translation is not 3 finite numbers"),
        ("ego_pose", {"token": "other"}, "no record .* which sample_data.json refers to"),
        ("calibrated_sensor", {"rotation": [1, 0, 0]}, "rotation is not 4 finite numbers"),
        ("calibrated_sensor", {"camera_intrinsic": []}, "camera_intrinsic is not 3 x 3 finite"),
        ("sample", {"scene_token": "none"}, "is missing or has no valid scene"),
    ],
)
def test_an_invalid_record_is_reported(root, table, edit, message):
    """With its table, in one line."""
    change(root / "v1.0-mini" / f"{table}.json", lambda record: record.update(edit))
    with pytest.raises(DataError, match=message) as caught:
        NuScenesDataset(root).frame_ids()
    assert f"{table}.json" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("table", ["scene", "sample_data", "sample_annotation"])
@pytest.mark.parametrize("damage", ["cut", "gone", "words"])
def test_a_damaged_table_is_reported(root, table, damage):
    """Missing, truncated, or of another format."""
    path, name = root / "v1.0-mini" / f"{table}.json", sample_token(SCENES[0], 0)
    content = path.read_bytes()
    dataset = NuScenesDataset(root)
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes(content[: len(content) // 2] if damage == "cut" else b"no table")
    with pytest.raises(DataError, match=f"{table}.json") as caught:
        dataset.annotations(name)
    assert "\n" not in str(caught.value)


def test_an_instance_without_category_is_reported(root):
    """Its annotation has no name."""
    change(
        root / "v1.0-mini" / "instance.json", lambda record: record.update({"category_token": "x"})
    )
    with pytest.raises(DataError, match=r"instance\.json: no instance .* with a category"):
        NuScenesDataset(root).annotations(sample_token(SCENES[0], 0))


def test_a_frame_that_does_not_exist_is_reported(unchanged_root):
    """Frame ids are sample tokens, not sample_data tokens."""
    with pytest.raises(DataError, match="no key frame 000001; frame ids are sample"):
        NuScenesDataset(unchanged_root).read("000001")


def test_annotations_of_other_frames_are_not_decoded(root):
    """Their records may be invalid."""
    path = root / "v1.0-mini" / "sample_annotation.json"
    other = sample_token(SCENES[1], 0)

    def spoil(record):
        if record["sample_token"] == other:
            record["translation"] = "secret"

    change(path, spoil)
    dataset = NuScenesDataset(root)
    assert len(dataset.annotations(sample_token(SCENES[0], 0))) == 3
    with pytest.raises(DataError, match="translation is not 3 finite numbers"):
        dataset.annotations(other)


def test_tables_can_be_larger_than_a_block(unchanged_root, monkeypatch):
    """Records that lie across two blocks are complete."""
    from curate.datasets.nuscenes import tables

    whole = NuScenesDataset(unchanged_root)
    name = sample_token(SCENES[1], 1)
    monkeypatch.setattr(tables, "CHUNK_BYTES", 97)
    pieces = NuScenesDataset(unchanged_root)
    assert pieces.frame_ids() == whole.frame_ids()
    np.testing.assert_array_equal(pieces.annotations(name).boxes, whole.annotations(name).boxes)


def test_frames_are_found_by_the_names_of_their_files(tmp_path):
    """As in mmdetection3d's lidar_path and COCO's file_name."""
    write_nuscenes(tmp_path)
    dataset = NuScenesDataset(tmp_path)
    names = FrameNames.of_dataset(dataset)
    for token in dataset.frame_ids():
        files = dataset.files(token)
        assert names.find(files.points.name) == token
        assert names.find(str(files.image.relative_to(tmp_path)).replace("/", "\\")) == token
