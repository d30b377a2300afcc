"""KITTI raw and the plain folder: the same frames as in KITTI's object layout."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from support.dataset_layouts import DRIVE, write_cloud, write_toy_folder, write_toy_raw
from support.toys import write_toy_kitti

from curate.datasets.folder import FolderDataset
from curate.datasets.formats.clouds import read_cloud
from curate.datasets.formats.point_layout import PointLayout
from curate.datasets.kitti.calibration import read_calibration, read_raw_calibration
from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.raw import KittiRawDataset
from curate.errors import ConfigError, DataError

LAYOUTS = {
    "raw": (write_toy_raw, KittiRawDataset, f"{DRIVE}_0000"),
    "folder": (write_toy_folder, FolderDataset, ""),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_frames_equal_those_of_kittis_layout(tmp_path, layout):
    """Points, calibration, image size and ground truth, in every point format."""
    write, kind, prefix = LAYOUTS[layout]
    write(tmp_path / "other")
    write_toy_kitti(tmp_path / "kitti", frames=4)
    kitti, other = KittiDataset(tmp_path / "kitti"), kind(tmp_path / "other")
    assert other.frame_ids() == tuple(f"{prefix}{name}" for name in kitti.frame_ids())
    for name in kitti.frame_ids():
        expected, found = kitti.read(name, image=True), other.read(f"{prefix}{name}", image=True)
        np.testing.assert_allclose(found.points, expected.points, atol=1e-5)
        np.testing.assert_array_equal(found.image, expected.image)
        one, two = expected.calibration, found.calibration
        np.testing.assert_allclose(two.lidar_to_image, one.lidar_to_image, atol=1e-12)
        truth = other.annotations(f"{prefix}{name}")
        np.testing.assert_allclose(truth.boxes, kitti.annotations(name).boxes, atol=1e-9)


def test_a_raw_frame_without_image_is_left_out(tmp_path):
    """Some drives have frames without one."""
    write_toy_raw(tmp_path)
    image = f"2011_09_26/{DRIVE}/image_02/data/0000000001.png"
    (tmp_path / image).unlink()
    assert len(KittiRawDataset(tmp_path).frame_ids()) == 3


def test_invalid_raw_calibration_is_reported(tmp_path):
    """Missing file, missing line, wrong count."""
    write_toy_raw(tmp_path)
    day = tmp_path / "2011_09_26"
    (day / "calib_cam_to_cam.txt").write_text("R_rect_00: 1 2 3\n")
    with pytest.raises(DataError, match=r"cam_to_cam\.txt:1: 3 numbers, expected 3 x 3"):
        read_raw_calibration(day)
    (day / "calib_velo_to_cam.txt").write_text("R: 1 0 0 0 1 0 0 0 1\n")
    with pytest.raises(DataError, match=r"velo_to_cam\.txt: no line T:"):
        read_raw_calibration(day)
    (day / "calib_velo_to_cam.txt").unlink()
    with pytest.raises(DataError, match=r"velo_to_cam\.txt: no such calibration file"):
        read_raw_calibration(day)


@pytest.mark.parametrize(
    ("line", "other", "message"),
    [
        ('images = "camera"\n', "images = 3\n", "invalid value of images"),
        ('images = "camera"\n', "image_size = [120]\n", r"image_size is \[120\], expected"),
        ('images = "camera"\n', "image_size = [120, 0.5]\n", r"image_size is \[120, 0.5\]"),
        ('images = "camera"\n', 'images = "camera"\nimage_size = [120, 40]\n', "remove one"),
        ('points = "lidar"\n', "", "no key points"),
        ("intensity_scale = 255\n", "intensity_scale = 0\n", "invalid value of intensity_scale"),
        ("intensity_scale = 255\n", "columns = 2\n", "columns = 2: must be 3 to 64"),
        (
            "intensity_scale = 255\n",
            f"intensity_scale = 1{'0' * 400}\n",
            "invalid value of intensity_scale",
        ),
        ("intensity_scale = 255\n", "rings = 64\n", "unknown key rings; use one of points"),
        ("projection = [[60.0,", "projection = [[", r"calibration\.projection must be 3 x 4"),
        ("projection = [[60.0,", f"projection = [[1{'0' * 400},", "projection must be 3 x 4"),
        ("[calibration]\n", "[calibration\n", "not TOML"),
    ],
)
def test_a_wrong_description_gives_a_one_line_error(tmp_path, line, other, message):
    """It contains the file and the key."""
    write_toy_folder(tmp_path)
    path = tmp_path / "dataset.toml"
    assert line in path.read_text()
    path.write_text(path.read_text().replace(line, other))
    with pytest.raises(DataError, match=message) as caught:
        FolderDataset(tmp_path).read("000000")
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_folder_without_lists_is_rejected(tmp_path):
    """A typo in its name must not turn val frames into training frames."""
    write_toy_folder(tmp_path)
    description = tmp_path / "dataset.toml"
    description.write_text('splits = "lists"\n' + description.read_text())
    with pytest.raises(DataError, match="contains no frame list such as train"):
        FolderDataset(tmp_path).splits()
    (tmp_path / "lists").mkdir()
    (tmp_path / "lists" / "train.txt").write_text("a\n")
    assert FolderDataset(tmp_path).splits() == {"train": ("a",)}


def test_frames_without_images_have_a_size(tmp_path):
    """Points and boxes in the image need no pixels."""
    write_toy_folder(tmp_path)
    expected = FolderDataset(tmp_path).read("000001")
    path = tmp_path / "dataset.toml"
    path.write_text(path.read_text().replace('images = "camera"', "image_size = [120, 40]"))
    shutil.rmtree(tmp_path / "camera")
    bare = FolderDataset(tmp_path)
    found = bare.read("000001")
    assert (found.image_size, found.image) == (expected.image_size, None)
    np.testing.assert_array_equal(found.points, expected.points)
    assert len(bare.annotations("000001")) == 3
    assert bare.read("000001", image=True).image is None
    assert bare.files("000001").images == ()


def test_the_calibration_can_be_a_kitti_file(tmp_path):
    write_toy_folder(tmp_path)
    calib = tmp_path / "made" / "training" / "calib" / "000000.txt"
    calib.rename(tmp_path / "calib.txt")
    (tmp_path / "dataset.toml").write_text(
        'points = "lidar"\nimages = "camera"\ncalibration = "calib.txt"\n'
    )
    dataset = FolderDataset(tmp_path)
    found = dataset.read("000000", points=False).calibration
    expected = read_calibration(tmp_path / "calib.txt")
    np.testing.assert_array_equal(found.lidar_to_image, expected.lidar_to_image)
    assert dataset.files("000000").label is None


@pytest.mark.parametrize("suffix", [".bin", ".npy", ".pcd", ".ply"])
def test_damaged_point_files_are_rejected(tmp_path, suffix):
    """In one line."""
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"no points at all!")
    with pytest.raises(DataError, match=f"a{suffix}: ") as caught:
        read_cloud(path)
    assert "\n" not in str(caught.value)


def test_points_that_are_not_finite_are_left_out(tmp_path):
    """Organised clouds mark missing returns by NaN."""
    points = np.array([[1, 2, 3, 100], [np.nan, 0, 0, 0], [4, 5, 6, 200]])
    write_cloud(tmp_path / "a.npy", points)
    found = read_cloud(tmp_path / "a.npy", PointLayout(intensity_scale=200))
    assert found.tolist() == [[1, 2, 3, 0.5], [4, 5, 6, 1]]


@pytest.mark.kitti
def test_real_frames_in_a_plain_folder(kitti_root: Path, tmp_path: Path):
    """Frames of a raw drive, described in three lines, equal those of KITTI's reader."""
    raw = kitti_root / "raw"
    name = KittiDataset(raw).frame_ids()[0]
    (tmp_path / "dataset.toml").write_text(
        f'points = "{raw / "velodyne"}"\nimages = "{raw / "image_2"}"\n'
        f'calibration = "{raw / "calib" / name}.txt"\n'
    )
    expected, found = (
        KittiDataset(raw).read(name),
        FolderDataset(tmp_path, follow_links=True).read(name),
    )
    np.testing.assert_array_equal(found.points, expected.points)
    assert found.image_size == expected.image_size


def with_cameras(root: Path, text: str) -> FolderDataset:
    """Write a toy folder with another description of its cameras."""
    write_toy_folder(root)
    shutil.copytree(root / "camera", root / "rear")
    head = 'points = "lidar"\nlabels = "boxes"\nintensity_scale = 255\n'
    (root / "dataset.toml").write_text(head + text)
    return FolderDataset(root)


MATRICES = (
    "projection = [[60.0, 0, 60, 0], [0, 60, 20, 0], [0, 0, 1, 0]]\n"
    "lidar_to_camera = [[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]\n"
)
FRONT = f'[cameras.front]\nimages = "camera"\n[cameras.front.calibration]\n{MATRICES}'
REAR = f'[cameras.rear]\nimages = "rear"\n[cameras.rear.calibration]\n{MATRICES}'


def test_a_folder_may_have_several_cameras(tmp_path):
    """Each with image, calibration and name; the labels are in the frame of the first."""
    dataset = with_cameras(tmp_path, FRONT + REAR)
    frame = dataset.read("000001", image=True)
    assert [camera.name for camera in frame.cameras] == ["front", "rear"]
    assert all(camera.image is not None for camera in frame.cameras)
    assert [path.parent.name for path in dataset.files("000001").images] == ["camera", "rear"]
    single = with_cameras(tmp_path / "one", FRONT)
    assert single.read("000001").camera == ""
    assert len(dataset.annotations("000001")) == len(single.annotations("000001")) == 3
    (tmp_path / "rear" / "000001.png").unlink()
    with pytest.raises(DataError, match=r"rear/000001\.png: no such image file"):
        dataset.read("000001")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f'images = "camera"\n{FRONT}', r"both images and \[cameras\.NAME\]; move images"),
        ("[cameras]\n", r"cameras must be tables \[cameras\.NAME\]"),
        ("cameras = 3\n", r"cameras must be tables \[cameras\.NAME\]"),
        ("[cameras]\nfront = 3\n", r"cameras\.front is not a table"),
        (FRONT.replace("images", "imgs"), r"unknown key cameras\.front\.imgs; did you mean 'im"),
        ('[cameras.front]\nimages = "camera"\n', r"no key cameras\.front\.calibration"),
        (
            FRONT + REAR.replace('images = "rear"', "image_size = [120, 40]"),
            "cameras front have images, the others only an image_size",
        ),
        (FRONT.replace("[[60.0,", "[["), r"cameras\.front\.calibration\.projection must be 3 x 4"),
        (FRONT.replace('images = "camera"\n', ""), "neither are set"),
        (FRONT.replace("front", '"../front"'), r"'\.\./front' is not a frame id"),
    ],
)
def test_a_wrong_camera_gives_a_one_line_error(tmp_path, text, message):
    """It contains the file and the key."""
    with pytest.raises(DataError, match=message) as caught:
        with_cameras(tmp_path, text).read("000001")
    assert "\n" not in str(caught.value)


def test_a_folder_without_camera_needs_a_calibration_only_for_labels(tmp_path):
    """Labels in KITTI's form are in a camera's frame of reference."""
    write_toy_folder(tmp_path)
    path = tmp_path / "dataset.toml"
    path.write_text('points = "lidar"\nintensity_scale = 255\n')
    dataset = FolderDataset(tmp_path)
    frame = dataset.read("000001", image=True)
    assert (frame.cameras, frame.image_size, frame.image) == ((), None, None)
    assert dataset.files("000001").image is None
    path.write_text('points = "lidar"\nlabels = "boxes"\n')
    with pytest.raises(DataError, match="no key calibration"):
        FolderDataset(tmp_path)


def test_kittis_layout_without_images_has_no_camera(tmp_path):
    """An image_2 without images is the same as none; a size can be declared."""
    write_toy_kitti(tmp_path, frames=2)
    expected = KittiDataset(tmp_path).annotations("000000")
    for path in (tmp_path / "training" / "image_2").iterdir():
        path.unlink()
    for bare in (True, False):
        dataset = KittiDataset(tmp_path)
        assert dataset.files("000000").images == ()
        assert dataset.read("000000", image=True).cameras == ()
        np.testing.assert_array_equal(dataset.annotations("000000").boxes, expected.boxes)
        if bare:
            (tmp_path / "training" / "image_2").rmdir()
    sized = KittiDataset(tmp_path, image_size=[120, 40]).read("000000")
    assert sized.image_size == (120, 40)
    for wrong in ([120], [120, 0], "large", [1.5, 2]):
        with pytest.raises(
            ConfigError, match=r"image_size is .* expected \[width, height\] in pix"
        ):
            KittiDataset(tmp_path, image_size=wrong)
