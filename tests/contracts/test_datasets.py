"""The contract of every registered dataset."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from contracts.samples import assert_one_line, assert_same, sample_of
from support.dataset_layouts import write_toy_folder, write_toy_raw, write_toy_tracking
from support.nuscenes_scenes import write_nuscenes
from support.toys import write_toy_kitti

from curate.errors import DataError
from curate.frames import Frame
from pipelines.registry import DATASETS

# Write four frames below a folder, all with label files.
SAMPLES: Mapping[str, Callable[[Path], None]] = {
    "kitti": lambda root: write_toy_kitti(root, frames=4, val=1),
    "kitti-raw": write_toy_raw,
    "kitti-tracking": write_toy_tracking,
    "folder": write_toy_folder,
    "nuscenes": write_nuscenes,
}


@pytest.fixture(params=sorted(DATASETS.classes))
def root(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Return the folder of four frames."""
    description = "a function that writes four small labeled frames below a folder"
    sample_of(SAMPLES, request.param, description)(tmp_path)
    return tmp_path


@pytest.fixture
def dataset(request: pytest.FixtureRequest, root: Path):
    """Return every registered dataset in turn."""
    return DATASETS.build(request.node.callspec.params["root"], root, offered={}, options={})


def same_frame(one: Frame, other: Frame) -> None:
    """Compare all fields of two frames."""
    assert (one.frame_id, one.image_size) == (other.frame_id, other.image_size)
    np.testing.assert_array_equal(one.points, other.points)
    assert_same(one.calibration, other.calibration)


def test_it_has_its_registered_name(dataset) -> None:
    assert dataset.name in DATASETS.classes


def test_frame_lists_are_sorted_and_without_duplicates(dataset) -> None:
    names = dataset.frame_ids()
    assert isinstance(names, tuple)
    assert len(names) == 4
    assert list(names) == sorted(set(names))
    for split in dataset.splits().values():
        assert set(split) <= set(names)


def test_a_frame_has_the_documented_shapes_types_and_units(dataset) -> None:
    """Points are float32, intensity is in [0, 1], calibrations are matrices, images are RGB."""
    for name in dataset.frame_ids():
        frame = dataset.read(name, image=True)
        assert frame.frame_id == name
        assert frame.points.dtype == np.float32
        assert frame.points.shape == (len(frame.points), 4)
        assert np.isfinite(frame.points).all()
        assert ((frame.points[:, 3] >= 0) & (frame.points[:, 3] <= 1)).all()
        assert frame.calibration.projection.shape == (3, 4)
        assert frame.calibration.lidar_to_camera.shape == (4, 4)
        width, height = frame.image_size
        assert frame.image is not None
        assert (frame.image.shape, frame.image.dtype) == ((height, width, 3), np.uint8)


def test_only_requested_data_is_read(dataset) -> None:
    """Neither points nor image are read; the size of the image is known all the same."""
    name = dataset.frame_ids()[0]
    whole, bare = dataset.read(name, image=True), dataset.read(name, points=False)
    assert bare.points.shape == (0, 4)
    assert bare.points.dtype == np.float32
    assert bare.image is None
    assert bare.image_size == whole.image_size
    assert_same(bare.calibration, whole.calibration)


def test_frames_do_not_depend_on_earlier_reads(dataset, root: Path) -> None:
    """Read in another order, again, or after a caller has written into the arrays."""
    names = dataset.frame_ids()
    before = {name: dataset.read(name) for name in names}
    kept = {name: frame.points.copy() for name, frame in before.items()}
    for frame in before.values():
        frame.points[:] = 0
    for name in reversed(names):
        again = dataset.read(name)
        np.testing.assert_array_equal(again.points, kept[name])
        same_frame(again, dataset.read(name))


def test_annotations_are_boxes_in_the_lidar_frame(dataset) -> None:
    """One row per object; a box has no size only if it is a DontCare region."""
    for name in dataset.frame_ids():
        truth = dataset.annotations(name)
        count = len(truth)
        assert count > 0
        assert (truth.boxes.shape, truth.boxes.dtype) == ((count, 7), np.float64)
        assert truth.boxes_2d.shape == (count, 4)
        assert truth.categories.dtype.kind == "U"
        assert truth.occluded.dtype == np.int64
        has_box = ~np.isnan(truth.boxes).any(axis=1)
        assert (truth.boxes[has_box, 3:6] > 0).all()
        assert (np.abs(truth.boxes[has_box, 6]) <= np.pi).all()
        assert set(truth.categories[~has_box]) <= {"DontCare"}
        assert_same(truth, dataset.annotations(name))


@pytest.mark.parametrize("part", ["points", "image", "calibration", "label"])
def test_a_missing_file_is_reported(dataset, part: str) -> None:
    """The DataError is one line; the other frames can still be read."""
    name, other = dataset.frame_ids()[:2]
    path = getattr(dataset.files(name), part)
    if path == getattr(dataset.files(other), part):
        pytest.skip("all frames share it")
    path.unlink()
    with pytest.raises(DataError) as caught:
        dataset.annotations(name) if part == "label" else dataset.read(name, image=True)
    assert_one_line(caught.value)
    assert path.name in str(caught.value)
    assert len(dataset.read(other, image=True).points) > 0


def test_a_frame_without_a_label_file_can_be_read(dataset, root: Path) -> None:
    """Unlabeled frames have none: `files` shows that, and the sensor data can be read."""
    name = dataset.frame_ids()[0]
    dataset.files(name).label.unlink()
    assert dataset.files(name).label is None
    assert name in dataset.frame_ids()
    assert len(dataset.read(name).points) > 0


def test_a_folder_without_a_dataset_is_rejected(
    request: pytest.FixtureRequest, dataset, tmp_path: Path
) -> None:
    """The DataError is one line that contains the folder."""
    (tmp_path / "nothing").mkdir()
    name = request.node.callspec.params["root"]
    with pytest.raises(DataError, match="nothing") as caught:
        DATASETS.build(name, tmp_path / "nothing", offered={}, options={}).frame_ids()
    assert_one_line(caught.value)
