"""KITTI tracking: sequences, label lines with frame and track, and skipped frames."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from support.dataset_layouts import write_toy_tracking
from support.toys import write_toy_kitti

from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.tracking import KittiTrackingDataset
from curate.errors import DataError


def label_file(root: Path, *lines: str) -> Path:
    """Write the labels of sequence 0000 and return their path."""
    path = root / "training" / "label_02" / "0000.txt"
    path.write_text("".join(f"{line}\n" for line in lines))
    return path


CAR = "Car 0 0 -1.5 600 170 640 200 1.5 1.6 3.9 1.0 1.7 20.0 -1.57"


def test_the_frames_equal_those_of_the_object_layout(tmp_path: Path) -> None:
    write_toy_tracking(tmp_path / "tracking")
    write_toy_kitti(tmp_path / "kitti", frames=4)
    tracking, kitti = KittiTrackingDataset(tmp_path / "tracking"), KittiDataset(tmp_path / "kitti")
    names = ("0000_000000", "0000_000001", "0001_000000", "0001_000001")
    assert tracking.frame_ids() == names
    assert [tracking.sequence_of(name) for name in names] == ["0000", "0000", "0001", "0001"]
    assert tracking.sequence_of("0002_000000") is None
    for name, other in zip(names, kitti.frame_ids(), strict=True):
        found, expected = tracking.read(name, image=True), kitti.read(other, image=True)
        np.testing.assert_array_equal(found.points, expected.points)
        np.testing.assert_array_equal(found.image, expected.image)
        np.testing.assert_allclose(
            found.calibration.lidar_to_image, expected.calibration.lidar_to_image, atol=1e-12
        )
        truth = tracking.annotations(name)
        np.testing.assert_allclose(truth.boxes, kitti.annotations(other).boxes, atol=1e-9)


def test_label_lines_belong_to_their_frames(tmp_path: Path) -> None:
    """In any order; a score is left out; truncation is a level; DontCare has no box."""
    write_toy_tracking(tmp_path)
    label_file(
        tmp_path,
        f"1 7 {CAR}",
        f"0 7 {CAR.replace('Car 0 0', 'Van 2 1')} 0.75",
        "",
        "1 -1 DontCare -1 -1 -10 219 188 245 218 -1000 -1000 -1000 -10 -1 -1 -1",
        f"1 9 {CAR.replace('Car 0 0', 'Person 1 2')}",
    )
    dataset = KittiTrackingDataset(tmp_path)
    first, second = dataset.annotations("0000_000000"), dataset.annotations("0000_000001")
    assert first.categories.tolist() == ["Van"]
    assert (first.truncated[0], first.occluded[0]) == (1.0, 1)
    assert second.categories.tolist() == ["Car", "DontCare", "Person"]
    assert second.truncated.tolist() == [0, -1, 0.5]
    assert np.isnan(second.boxes[1]).all()
    np.testing.assert_allclose(second.boxes[0, 3:6], [3.9, 1.6, 1.5])
    assert second.boxes_2d[1].tolist() == [219, 188, 245, 218]


def test_a_frame_without_a_line_has_no_objects(tmp_path: Path) -> None:
    write_toy_tracking(tmp_path)
    label_file(tmp_path, f"1 7 {CAR}")
    assert len(KittiTrackingDataset(tmp_path).annotations("0000_000000")) == 0


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (CAR, r"0000\.txt:2: 15 fields, but lines of KITTI tracking have 17, or 18"),
        (f"0 7 {CAR} 0.5 1", r"0000\.txt:2: 19 fields"),
        (f"zero 7 {CAR}", r"0000\.txt:2: begins with 'zero 7', expected the numbers"),
        (f"0 7 {CAR.replace('20.0', 'far')}", r"0000\.txt:2: 'far' is not a number"),
    ],
)
def test_an_invalid_line_is_reported(tmp_path: Path, line: str, message: str) -> None:
    write_toy_tracking(tmp_path)
    label_file(tmp_path, f"1 7 {CAR}", line)
    with pytest.raises(DataError, match=message):
        KittiTrackingDataset(tmp_path).annotations("0000_000000")


def test_skipped_frames_are_counted(tmp_path: Path) -> None:
    write_toy_tracking(tmp_path)
    for number in ("000000", "000001"):
        (tmp_path / "training" / "image_02" / "0001" / f"{number}.png").unlink()
    dataset = KittiTrackingDataset(tmp_path)
    assert dataset.frame_ids() == ("0000_000000", "0000_000001")
    assert dataset.skipped_frames() == "2 of 4 frames have no image and are skipped"


def test_without_images_there_is_no_camera(tmp_path: Path) -> None:
    """Unless the size of the image is given."""
    write_toy_tracking(tmp_path)
    shutil.rmtree(tmp_path / "training" / "image_02")
    dataset = KittiTrackingDataset(tmp_path)
    assert len(dataset.frame_ids()) == 4
    assert dataset.files("0000_000000").image is None
    assert dataset.read("0000_000000").cameras == ()
    (camera,) = KittiTrackingDataset(tmp_path, image_size=[120, 40]).read("0000_000000").cameras
    assert camera.image_size == (120, 40)


def test_lists_of_the_sequence_are_read(tmp_path: Path) -> None:
    write_toy_tracking(tmp_path)
    (tmp_path / "ImageSets").mkdir()
    (tmp_path / "ImageSets" / "val.txt").write_text("0001_000000\n0001_000001\n")
    splits = KittiTrackingDataset(tmp_path).splits()
    assert splits == {"val": ("0001_000000", "0001_000001")}
