"""Times and poses of data sets with sequences."""

from pathlib import Path

import numpy as np
import pytest
from support.dataset_layouts import DRIVE, write_toy_folder, write_toy_raw, write_toy_tracking
from support.nuscenes_scenes import sample_token, write_nuscenes
from support.toys import write_toy_kitti

from curate.datasets.base import pose_of, sequences_of, time_of
from curate.datasets.folder import FolderDataset
from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.raw import KittiRawDataset
from curate.datasets.kitti.tracking import KittiTrackingDataset
from curate.datasets.nuscenes import NuScenesDataset
from curate.errors import DataError

LATITUDE, LONGITUDE = 49.0, 8.4
METRE_DEG = 360 / (2 * np.pi * 6378137)  # of latitude; KITTI's map is a sphere
# The IMU is 1 m behind and 0.5 m to the right of the LiDAR, and looks the same way.
IMU_TO_LIDAR = "1 0 0 -1 0 1 0 -0.5 0 0 1 0.25"


def oxts(metres_north: float, yaw: float) -> str:
    """Return an OXTS line of a vehicle north of the start."""
    place = LATITUDE + metres_north * METRE_DEG
    return " ".join(map(repr, [place, LONGITUDE, 110.0, 0.0, 0.0, yaw, *[0.0] * 24]))


def assert_drives_north(poses: list[np.ndarray], metres: float) -> None:
    """Check the poses of a vehicle that drives north, and the lever arm of the IMU."""
    relative = np.linalg.inv(poses[0]) @ poses[1]
    np.testing.assert_allclose(relative[:3, 3], [metres, 0, 0], atol=metres * 1e-4)
    np.testing.assert_allclose(relative[:3, :3], np.eye(3), atol=1e-9)
    np.testing.assert_allclose(poses[0][:3, 0], [0, 1, 0], atol=1e-9)  # x of the LiDAR: north
    imu_in_lidar = np.array([-1, -0.5, 0.25, 1])
    place = poses[0] @ imu_in_lidar
    assert place[2] == pytest.approx(110)
    expected = 6378137 * np.cos(np.deg2rad(LATITUDE)) * np.deg2rad(LONGITUDE)
    assert place[0] == pytest.approx(expected, abs=1e-3)


def test_kitti_raw(tmp_path: Path) -> None:
    """timestamps.txt by the number of the frame; oxts and calib_imu_to_velo.txt."""
    write_toy_raw(tmp_path, 3)
    dataset = KittiRawDataset(tmp_path)
    frames = dataset.frame_ids()
    assert [time_of(dataset, name) for name in frames] == [None] * 3
    assert [pose_of(dataset, name) for name in frames] == [None] * 3
    drive = tmp_path / "2011_09_26" / DRIVE
    times = "".join(f"2011-09-26 13:02:25.{number}94360375\n" for number in range(3))
    (drive / "velodyne_points" / "timestamps.txt").write_text(times)
    (drive / "oxts" / "data").mkdir(parents=True)
    for i in range(3):
        path = drive / "oxts" / "data" / f"{i:010d}.txt"
        path.write_text(oxts(2.0 * i, np.pi / 2) + "\n")
    calibration = tmp_path / "2011_09_26" / "calib_imu_to_velo.txt"
    calibration.write_text("calib_time: x\nR: 1 0 0 0 1 0 0 0 1\nT: -1 -0.5 0.25\n")
    dataset = KittiRawDataset(tmp_path)
    found = [time_of(dataset, name) for name in frames]
    assert np.diff(found).tolist() == pytest.approx([0.1, 0.1], abs=1e-6)
    assert_drives_north([pose_of(dataset, name) for name in frames], 2.0)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("velodyne_points/timestamps.txt", "2011-09-26\n", r"timestamps.txt:1: .* is not a time"),
        ("velodyne_points/timestamps.txt", "2011-09-26 13:02:25.1\n", "no line for frame 2"),
        ("oxts/data/0000000002.txt", "1 2 x\n", r"0000000002.txt:1: .* only numbers"),
        ("oxts/data/0000000002.txt", "95 8 110 0 0 0\n", "expected latitude, longitude"),
        ("oxts/data/0000000002.txt", "", "0 lines, expected one"),
        ("oxts/data/0000000002.txt", "nan 8 110 0 0 0\n", "expected latitude, longitude"),
        ("oxts/data/0000000001.txt", oxts(0, 0), "0000000002.txt: no such OXTS file"),
        ("oxts/data/0000000002.txt", oxts(0, 0), "calib_imu_to_velo.txt: no such"),
    ],
)
def test_malformed_files_of_kitti_raw(tmp_path: Path, file: str, content: str, message) -> None:
    """They fail the sequence, not the data set: frames can still be read."""
    write_toy_raw(tmp_path, 3)
    path = tmp_path / "2011_09_26" / DRIVE / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    dataset = KittiRawDataset(tmp_path)
    name = dataset.frame_ids()[2]
    dataset.read(name)
    with pytest.raises(DataError, match=message):
        (time_of if "timestamps" in file else pose_of)(dataset, name)


def test_kitti_tracking(tmp_path: Path) -> None:
    """oxts/0000.txt has a line per frame; the calibration has the place of the IMU."""
    write_toy_tracking(tmp_path, 4)
    dataset = KittiTrackingDataset(tmp_path)
    frames = dataset.frame_ids()
    assert [pose_of(dataset, name) for name in frames] == [None] * 4
    home = tmp_path / "training"
    (home / "oxts").mkdir()
    lines = [oxts(3.0 * i, np.pi / 2) for i in range(2)]
    (home / "oxts" / "0000.txt").write_text("\n".join(lines) + "\n")
    (home / "oxts" / "0001.txt").write_text(lines[0] + "\n")
    with (home / "calib" / "0000.txt").open("a") as file:
        file.write(f"Tr_imu_velo {IMU_TO_LIDAR}\n")
    dataset = KittiTrackingDataset(tmp_path)
    assert_drives_north([pose_of(dataset, name) for name in frames[:2]], 3.0)
    assert time_of(dataset, frames[0]) is None
    with pytest.raises(DataError, match=r"0001.txt: no line for frame 1"):
        pose_of(dataset, frames[3])
    with pytest.raises(DataError, match=r"0001.txt: no line Tr_imu_velo"):
        pose_of(dataset, frames[2])


def test_nuscenes(tmp_path: Path) -> None:
    """Times of the samples; the pose is that of the calibration, and z of the map is up."""
    write_nuscenes(tmp_path)
    dataset = NuScenesDataset(tmp_path)
    names = [sample_token("scene-0061", step) for step in range(2)]
    assert np.diff([time_of(dataset, name) for name in names]).tolist() == [0.5]
    for name in names:
        pose = pose_of(dataset, name)
        calibration = dataset.read(name, points=False).calibration
        np.testing.assert_array_equal(pose, calibration.lidar_to_map)
        assert pose[2, 2] > 0.99


def test_kitti_with_the_mapping_of_its_kit(tmp_path: Path) -> None:
    """The frames of a drive are not in the order of their names; the kit has their numbers."""
    write_toy_kitti(tmp_path, 3)
    assert time_of(KittiDataset(tmp_path), "000001") is None
    (tmp_path / "mapping").mkdir()
    (tmp_path / "mapping" / "train_mapping.txt").write_text(
        "2011_09_26 drive_5 0000000109\n2011_09_26 drive_5 0000000104\n\n"
    )
    (tmp_path / "mapping" / "train_rand.txt").write_text("2,1")
    dataset = KittiDataset(tmp_path)
    assert [time_of(dataset, f"{i:06d}") for i in range(3)] == [10.4, 10.9, None]
    assert pose_of(dataset, "000000") is None
    (tmp_path / "mapping" / "train_mapping.txt").write_text("2011_09_26 drive_5 first\n")
    with pytest.raises(DataError, match="'first' is not the number of a frame"):
        time_of(KittiDataset(tmp_path), "000000")


def folder(root: Path, keys: str) -> FolderDataset:
    """Write a plain folder with further keys in dataset.toml."""
    write_toy_folder(root, 2)
    path = root / "dataset.toml"
    path.write_text(keys + path.read_text())
    return FolderDataset(root)


def test_a_plain_folder(tmp_path: Path) -> None:
    dataset = folder(tmp_path, 'poses = "poses"\ntimes = "times.txt"\n')
    (tmp_path / "times.txt").write_text("# frame seconds\n000000 17.5\n\n000001 18\n")
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "000000.txt").write_text("1 0 0 5\n0 1 0 6\n0 0 1 7\n")
    (tmp_path / "poses" / "000001.txt").write_text("0 -1 0 5 1 0 0 6 0 0 1 7 0 0 0 1")
    assert [time_of(dataset, name) for name in dataset.frame_ids()] == [17.5, 18]
    assert pose_of(dataset, "000000").tolist() == [
        [1, 0, 0, 5],
        [0, 1, 0, 6],
        [0, 0, 1, 7],
        [0, 0, 0, 1],
    ]
    assert pose_of(dataset, "000001")[:2, :2].tolist() == [[0, -1], [1, 0]]
    assert sequences_of(dataset, dataset.frame_ids()) == {}


def test_a_plain_folder_without_the_keys(tmp_path: Path) -> None:
    dataset = folder(tmp_path, "")
    assert time_of(dataset, "000000") is None
    assert pose_of(dataset, "000000") is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("000001 1\n", "no line for frame 000000"),
        ("000000\n", r"times.txt:1: '000000' is not a frame and its time"),
        ("000000 noon\n", r"times.txt:1: .*'noon'"),
        ("000000 nan\n", r"times.txt:1: contains NaN"),
        ("000000 1\n000000 2\n", "times.txt:2: frame 000000 is listed twice"),
    ],
)
def test_malformed_times(tmp_path: Path, content: str, message: str) -> None:
    dataset = folder(tmp_path, 'times = "times.txt"\n')
    (tmp_path / "times.txt").write_text(content)
    with pytest.raises(DataError, match=message):
        time_of(dataset, "000000")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1 0 0 0", "4 numbers, expected 12 or 16"),
        ("2 0 0 0 0 2 0 0 0 0 2 0", "the pose is not a rotation"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0", "the pose mirrors"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 2", "the last row of the pose must be 0 0 0 1"),
        ("1 0 0 inf 0 1 0 0 0 0 1 0", "contains NaN, infinite"),
    ],
)
def test_malformed_poses(tmp_path: Path, content: str, message: str) -> None:
    dataset = folder(tmp_path, 'poses = "poses"\n')
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "000000.txt").write_text(content)
    with pytest.raises(DataError, match=message):
        pose_of(dataset, "000000")
    with pytest.raises(DataError, match=r"000001.txt: no such pose file"):
        pose_of(dataset, "000001")
