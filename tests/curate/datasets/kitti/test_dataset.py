"""The KITTI reader: layouts, points, calibration, images, and every kind of invalid file."""

import struct

import cv2
import numpy as np
import pytest
from support.toys import toy_calibration, write_toy_kitti

from curate.datasets.kitti.calibration import read_calibration, write_calibration
from curate.datasets.kitti.dataset import KittiDataset, read_points
from curate.errors import DataError
from curate.frames import Calibration
from curate.geometry.projection import project_points

CALIBRATION = """P0: 1 0 0 0 0 1 0 0 0 0 1 0
P2: 60 0 60 1 0 60 20 2 0 0 1 3
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3

"""


@pytest.fixture
def flat_kitti(toy_kitti):
    """Return the toy frames in the flat layout, without labels and lists."""
    root = toy_kitti.parent / "flat"
    root.mkdir()
    for folder in ("velodyne", "image_2", "calib"):
        (toy_kitti / "training" / folder).rename(root / folder)
    return root


def one_line(caught):
    """Return the message of an error, after checking that it is one line."""
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_it_lists_the_frames_that_have_points(toy_kitti):
    """Frames are sorted; files with other suffixes are ignored."""
    (toy_kitti / "training" / "velodyne" / "notes.txt").write_text("")
    (toy_kitti / "training" / "velodyne" / "000003.bin").unlink()
    expected = [f"{i:06d}" for i in range(12) if i != 3]
    assert list(KittiDataset(toy_kitti).frame_ids()) == expected


def test_hidden_files_are_neither_frames_nor_lists(toy_kitti):
    """MacOS leaves files beginning with ._ beside the files that it copies."""
    (toy_kitti / "training" / "velodyne" / "._000003.bin").write_bytes(b"\x00\x05\x16\x07")
    (toy_kitti / "ImageSets" / "._train.txt").write_bytes(b"\x00\x05/\x07")
    dataset = KittiDataset(toy_kitti)
    assert list(dataset.frame_ids()) == [f"{i:06d}" for i in range(12)]
    assert set(dataset.splits()) == {"train", "val"}


def test_a_frame_is_read_with_and_without_its_image(toy_kitti):
    """Size and points are the same; pixels are read only if requested."""
    dataset = KittiDataset(toy_kitti)
    bare, full = dataset.read("000001"), dataset.read("000001", image=True)
    assert bare.image is None
    assert full.image.shape == (40, 120, 3)
    assert full.image.dtype == np.uint8
    assert bare.image_size == full.image_size == (120, 40)
    assert bare.points.dtype == np.float32
    assert bare.points.shape[1] == 4
    np.testing.assert_array_equal(bare.points, full.points)


def test_images_are_rgb(toy_kitti):
    """The first channel is red, whatever OpenCV's order is."""
    red = np.zeros((4, 6, 3), np.uint8)
    red[..., 2] = 255
    cv2.imwrite(str(toy_kitti / "training" / "image_2" / "000000.png"), red)
    image = KittiDataset(toy_kitti).read("000000", image=True).image
    assert (image == [255, 0, 0]).all()


def test_a_flat_folder_without_labels(flat_kitti):
    """Frames without labels and lists can be read, but have no annotations."""
    dataset = KittiDataset(flat_kitti)
    assert len(dataset.frame_ids()) == 12
    assert dataset.splits() == {}
    assert dataset.files("000001").label is None
    assert len(dataset.read("000001").points) > 0
    with pytest.raises(DataError) as caught:
        dataset.annotations("000001")
    assert one_line(caught) == f"{flat_kitti}/label_2/000001.txt: no such label file"


def test_a_root_without_points_is_rejected(tmp_path):
    """The error contains the root and what should be in it."""
    with pytest.raises(DataError, match="contains neither training/velodyne nor velodyne"):
        KittiDataset(tmp_path)


def test_it_reads_the_lists_of_frames(toy_kitti):
    """Empty lines are skipped; frames need not exist."""
    (toy_kitti / "ImageSets" / "train.txt").write_text("000001\n\n000777\n")
    splits = KittiDataset(toy_kitti).splits()
    assert splits["train"] == ("000001", "000777")
    assert len(splits["val"]) == 4


def test_the_list_of_testing_frames_is_left_out(toy_kitti):
    """KITTI's test.txt lists the frames of testing/, not those of training/."""
    (toy_kitti / "ImageSets" / "test.txt").write_text("000001\n")
    assert "test" not in KittiDataset(toy_kitti).splits()


def test_a_missing_frame_in_a_list_fails_when_read(toy_kitti):
    """The error contains the missing file."""
    with pytest.raises(DataError) as caught:
        KittiDataset(toy_kitti).read("000777")
    assert one_line(caught).endswith("velodyne/000777.bin: no such point file")


@pytest.mark.parametrize("name", ["", ".", "..", "../000001", "a/b", "/etc/passwd", "a\\b", "a\0b"])
def test_a_frame_id_cannot_leave_the_dataset(toy_kitti, name):
    """Only plain file names are frame ids."""
    with pytest.raises(DataError, match="is not a frame id"):
        KittiDataset(toy_kitti).read(name)


def test_a_list_with_a_path_in_it_is_rejected(toy_kitti):
    """The error contains the list and the line."""
    (toy_kitti / "ImageSets" / "train.txt").write_text("000001\n../../secret\n")
    with pytest.raises(DataError, match=r"train\.txt:2: '\.\./\.\./secret' is not a frame id"):
        KittiDataset(toy_kitti).splits()


def test_a_list_must_be_text(toy_kitti):
    """With or without a byte order mark; undecodable bytes are rejected."""
    (toy_kitti / "ImageSets" / "train.txt").write_bytes(b"\xef\xbb\xbf000001\n")
    assert KittiDataset(toy_kitti).splits()["train"] == ("000001",)
    (toy_kitti / "ImageSets" / "train.txt").write_bytes(b"000001\n\xff\xfe\n")
    with pytest.raises(DataError, match=r"train\.txt:2: not UTF-8 text"):
        KittiDataset(toy_kitti).splits()


def test_annotations_are_in_the_lidar_frame(toy_kitti):
    """The labelled boxes contain the bright points of the toy frames."""
    dataset = KittiDataset(toy_kitti)
    truth, frame = dataset.annotations("000002"), dataset.read("000002")
    assert truth.categories.tolist() == ["Car", "Pedestrian", "Cyclist"]
    cloud = frame.points[np.abs(frame.points[:, 3] - 0.9) < 0.01, :3]
    assert np.linalg.norm(cloud.mean(axis=0) - truth.boxes[0, :3]) < 0.8


def test_an_invalid_label_line_is_reported(toy_kitti):
    """`annotations` raises with file and line."""
    path = toy_kitti / "training" / "label_2" / "000002.txt"
    path.write_text("Unicorn" + path.read_text()[3:])
    with pytest.raises(DataError, match=r"000002\.txt:1: unknown category 'Unicorn'"):
        KittiDataset(toy_kitti).annotations("000002")


def test_an_empty_sweep_is_valid(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"")
    points = read_points(path)
    assert points.shape == (0, 4)
    assert points.dtype == np.float32


@pytest.mark.parametrize("size", [1, 15, 17, 16 * 5 + 4])
def test_truncated_points_are_rejected(tmp_path, size):
    """The error contains the file and its size."""
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(size))
    with pytest.raises(DataError) as caught:
        read_points(path)
    assert one_line(caught).startswith(f"{path}: {size} bytes are not a multiple of 16")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("column", [0, 3])
def test_points_that_are_not_finite_are_counted(tmp_path, value, column):
    """The error contains their number and the index of the first."""
    points = np.ones((10, 4), np.float32)
    points[[4, 7], column] = value
    path = tmp_path / "a.bin"
    points.tofile(path)
    with pytest.raises(DataError) as caught:
        read_points(path)
    assert "2 of 10 points are NaN or infinite, the first is point 4" in one_line(caught)
    assert str(path) in str(caught.value)


def test_calibration_is_read_by_name(tmp_path):
    """The LiDAR-to-camera transform is R0_rect times Tr_velo_to_cam."""
    path = tmp_path / "a.txt"
    path.write_text(CALIBRATION.replace("R0_rect: 1 0 0 0 1", "R0_rect: 0 1 0 -1 0"))
    calibration = read_calibration(path)
    assert calibration.projection.tolist() == [[60, 0, 60, 1], [0, 60, 20, 2], [0, 0, 1, 3]]
    expected = [[0, 0, -1, 0.2], [0, 1, 0, -0.1], [1, 0, 0, 0.3], [0, 0, 0, 1]]
    assert calibration.lidar_to_camera.tolist() == expected


@pytest.mark.parametrize(
    ("former", "later", "message"),
    [
        ("P2:", "P4:", "no line P2:"),
        ("R0_rect:", "R:", "no line R0_rect:"),
        ("Tr_velo_to_cam:", "", "no line Tr_velo_to_cam:"),
        ("P2: 60", "P2:", r":2: 11 numbers, expected 3 x 4"),
        ("R0_rect: 1", "R0_rect: 1 1", r":3: 10 numbers, expected 3 x 3"),
        ("0.3\n", "inf\n", r":4: contains NaN or infinite numbers"),
        ("0.3\n", "zero\n", r":4: could not convert string to float: 'zero'"),
        ("R0_rect: 1 0 0", "R0_rect: 0 0 0", "is not a rotation .* lengths are 0, 1, 1"),
        ("R0_rect: 1 0 0", "R0_rect: 1 0.1 0", "is not a rotation"),
        ("R0_rect: 1 0 0", "R0_rect: -1 0 0", "mirrors"),
    ],
)
def test_invalid_calibration_is_reported_with_its_position(tmp_path, former, later, message):
    """File, line if there is one, and reason."""
    path = tmp_path / "a.txt"
    assert former in CALIBRATION
    path.write_text(CALIBRATION.replace(former, later))
    with pytest.raises(DataError, match=message) as caught:
        read_calibration(path)
    assert one_line(caught).startswith(str(path))


def test_missing_calibration_is_reported(toy_kitti):
    """The error contains the path."""
    path = toy_kitti / "training" / "calib" / "000000.txt"
    path.unlink()
    with pytest.raises(DataError) as caught:
        KittiDataset(toy_kitti).read("000000")
    assert one_line(caught) == f"{path}: no such calibration file"


def test_calibration_is_written_and_read_exactly(tmp_path):
    """Every bit of the matrices is the same."""
    generator = np.random.default_rng(0)
    calibration = Calibration(generator.normal(size=(3, 4)), toy_calibration().lidar_to_camera)
    calibration.lidar_to_camera[:3] += generator.normal(scale=0.001, size=(3, 4))
    write_calibration(tmp_path / "a.txt", calibration)
    back = read_calibration(tmp_path / "a.txt")
    np.testing.assert_array_equal(back.projection, calibration.projection)
    np.testing.assert_array_equal(back.lidar_to_camera, calibration.lidar_to_camera)


@pytest.mark.parametrize("image", [False, True])
@pytest.mark.parametrize("content", [b"", b"no image", b"\x89PNG\r\n\x1a\n"])
def test_an_unreadable_image_is_rejected(toy_kitti, image, content):
    """Whether the pixels or only the size are requested."""
    path = toy_kitti / "training" / "image_2" / "000000.png"
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        KittiDataset(toy_kitti).read("000000", image=image)
    assert one_line(caught).startswith(f"{path}: ")


def test_a_truncated_png_is_rejected(toy_kitti):
    """Its header is complete, but not its pixels."""
    path = toy_kitti / "training" / "image_2" / "000000.png"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(DataError, match="the PNG is truncated"):
        KittiDataset(toy_kitti).read("000000", image=True)


def test_a_missing_image_is_reported(toy_kitti):
    """The error contains the expected PNG."""
    path = toy_kitti / "training" / "image_2" / "000000.png"
    path.unlink()
    with pytest.raises(DataError) as caught:
        KittiDataset(toy_kitti).read("000000")
    assert one_line(caught) == f"{path}: no such image file"


def test_jpeg_images_are_read_if_there_is_no_png(toy_kitti):
    """The size comes from the decoded image."""
    folder = toy_kitti / "training" / "image_2"
    pixels = np.full((30, 50, 3), 128, np.uint8)
    cv2.imwrite(str(folder / "000000.jpg"), pixels)
    (folder / "000000.png").unlink()
    frame = KittiDataset(toy_kitti).read("000000")
    assert frame.image_size == (50, 30)


def test_only_the_header_is_read_for_the_size(toy_kitti):
    path = toy_kitti / "training" / "image_2" / "000000.png"
    header = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">II", 1242, 375)
    path.write_bytes(header)
    assert KittiDataset(toy_kitti).read("000000").image_size == (1242, 375)


def test_frames_without_labels_have_no_label_path(tmp_path):
    """The label path is None, not a path to a missing file."""
    write_toy_kitti(tmp_path, frames=1, labels=False)
    assert KittiDataset(tmp_path).files("000000").label is None


def test_real_frames(kitti_root):
    """The 24 labelled frames and the 13 of the raw drive match their description."""
    labelled, raw = KittiDataset(kitti_root), KittiDataset(kitti_root / "raw")
    assert len(labelled.frame_ids()) == 24
    assert len(raw.frame_ids()) == 13
    frame = labelled.read("000008", image=True)
    assert frame.image.shape == (375, 1242, 3)
    assert len(frame.points) > 100_000
    assert labelled.annotations("000008").categories.tolist() == ["Car"] * 6 + ["DontCare"] * 4
    assert raw.read("000072").points.shape[1] == 4
    assert raw.files("000072").label is None


def test_real_calibration_projects_points_of_a_car_into_its_rectangle(kitti_root):
    """The points inside a labelled 3D box appear inside its labelled 2D box."""
    from curate.geometry.points_in_boxes import points_in_box_mask

    dataset = KittiDataset(kitti_root)
    frame, truth = dataset.read("000008"), dataset.annotations("000008")
    inside = points_in_box_mask(frame.points, truth.boxes[3])
    pixels, depth = project_points(frame.points[inside], frame.calibration)
    left, top, right, bottom = truth.boxes_2d[3]
    assert inside.sum() > 100
    assert depth.min() > 10
    assert ((pixels > (left - 3, top - 3)) & (pixels < (right + 3, bottom + 3))).all()


def test_points_can_be_left_out(toy_kitti):
    """Calibration and image are read although the point file is damaged."""
    (toy_kitti / "training" / "velodyne" / "000001.bin").write_bytes(b"truncated")
    frame = KittiDataset(toy_kitti).read("000001", points=False)
    assert frame.points.shape == (0, 4)
    assert frame.image_size == (120, 40)
