"""What every registered data set promises."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from contracts.samples import assert_one_line, assert_same, sample_of
from support.dataset_layouts import write_toy_folder, write_toy_raw
from support.nuscenes_scenes import write_nuscenes
from support.toys import write_toy_kitti

from curate.errors import DataError
from curate.frames import Frame
from pipelines.registry import DATASETS

# Writes four frames below a folder, all with label files.
SAMPLES: Mapping[str, Callable[[Path], None]] = {
    "kitti": lambda root: write_toy_kitti(root, frames=4, val=1),
    "kitti-raw": write_toy_raw,
    "folder": write_toy_folder,
    "nuscenes": write_nuscenes,
}


@pytest.fixture(params=sorted(DATASETS.classes))
def root(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """The folder of four frames."""
    wanted = "a function that writes four small labeled frames below a folder"
    sample_of(SAMPLES, request.param, wanted)(tmp_path)
    return tmp_path


@pytest.fixture
def dataset(request: pytest.FixtureRequest, root: Path):
    """Every registered data set."""
    return DATASETS.build(request.node.callspec.params["root"], root, offered={}, options={})


def same_frame(one: Frame, other: Frame) -> None:
    """Two frames hold the same."""
    assert (one.frame_id, one.image_size) == (other.frame_id, other.image_size)
    np.testing.assert_array_equal(one.points, other.points)
    assert_same(one.calibration, other.calibration)


def test_it_goes_by_its_registered_name(dataset) -> None:
    """So that exported files say where their frames are from."""
    assert dataset.name in DATASETS.classes


def test_frames_are_sorted_and_lists_name_some_of_them(dataset) -> None:
    """Nothing occurs twice."""
    names = dataset.frame_ids()
    assert isinstance(names, tuple)
    assert len(names) == 4
    assert list(names) == sorted(set(names))
    for split in dataset.splits().values():
        assert set(split) <= set(names)


def test_a_frame_has_shapes_types_and_units(dataset) -> None:
    """Points in float32, intensity within [0, 1], matrices of a calibration, RGB where asked."""
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


def test_only_what_is_wanted_is_read(dataset) -> None:
    """Neither points nor image; the size of the image is known all the same."""
    name = dataset.frame_ids()[0]
    whole, bare = dataset.read(name, image=True), dataset.read(name, points=False)
    assert bare.points.shape == (0, 4)
    assert bare.points.dtype == np.float32
    assert bare.image is None
    assert bare.image_size == whole.image_size
    assert_same(bare.calibration, whole.calibration)


def test_frames_do_not_depend_on_what_was_read_before(dataset, root: Path) -> None:
    """Read in another order, again, or after a caller has written into one."""
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
    """A row per object; a box without sizes only for a region that has none."""
    for name in dataset.frame_ids():
        truth = dataset.annotations(name)
        count = len(truth)
        assert count > 0
        assert (truth.boxes.shape, truth.boxes.dtype) == ((count, 7), np.float64)
        assert truth.boxes_2d.shape == (count, 4)
        assert truth.categories.dtype.kind == "U"
        assert truth.occluded.dtype == np.int64
        known = ~np.isnan(truth.boxes).any(axis=1)
        assert (truth.boxes[known, 3:6] > 0).all()
        assert (np.abs(truth.boxes[known, 6]) <= np.pi).all()
        assert set(truth.categories[~known]) <= {"DontCare"}
        assert_same(truth, dataset.annotations(name))


@pytest.mark.parametrize("part", ["points", "image", "calibration", "label"])
def test_a_missing_file_is_named(dataset, part: str) -> None:
    """DataError in one line; the other frames can still be read."""
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


def test_a_frame_without_label_file_is_a_frame(dataset, root: Path) -> None:
    """X_u has none: `files` says so and the sensors' data can be read."""
    name = dataset.frame_ids()[0]
    dataset.files(name).label.unlink()
    assert dataset.files(name).label is None
    assert name in dataset.frame_ids()
    assert len(dataset.read(name).points) > 0


def test_a_folder_that_holds_no_data_set_is_rejected(
    request: pytest.FixtureRequest, dataset, tmp_path: Path
) -> None:
    """DataError in one line that names the folder."""
    (tmp_path / "nothing").mkdir()
    name = request.node.callspec.params["root"]
    with pytest.raises(DataError, match="nothing") as caught:
        DATASETS.build(name, tmp_path / "nothing", offered={}, options={}).frame_ids()
    assert_one_line(caught.value)
