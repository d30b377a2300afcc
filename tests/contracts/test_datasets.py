"""The contract of every registered dataset."""

from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
from contracts.samples import assert_one_line, assert_same, sample_of
from support.copied import TURNED, assert_is_copy, copied
from support.dataset_layouts import write_toy_folder, write_toy_raw, write_toy_tracking
from support.nuscenes_scenes import write_nuscenes
from support.toys import write_toy_kitti

from curate.datasets.base import pose_of, time_of
from curate.datasets.formats.point_layout import PointLayout
from curate.errors import DataError
from curate.frames import Frame
from curate.geometry.similarity import Similarity
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


def test_times_and_poses_have_the_documented_types(dataset) -> None:
    """A time is a number of seconds, a pose a rigid (4, 4) transform; either may be unknown."""
    for name in dataset.frame_ids():
        time, pose = time_of(dataset, name), pose_of(dataset, name)
        assert time is None or isinstance(time, float)
        if pose is not None:
            np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
            assert pose[3].tolist() == [0, 0, 0, 1]


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


def test_two_point_files_or_images_of_a_frame_are_rejected(
    request: pytest.FixtureRequest, dataset, root: Path
) -> None:
    """When the frames are listed, so at init; both files are in the message."""
    kind = request.node.callspec.params["root"]
    if kind == "nuscenes":
        pytest.skip("its tables contain the file of each frame")
    files = dataset.files(dataset.frame_ids()[1])
    others = {files.points: (".npy", ".pcd", ".BIN"), files.image: (".jpg", ".JPEG", ".PNG")}
    for path, suffixes in others.items():
        for suffix in suffixes:
            second = path.with_suffix(suffix)
            if second.exists():
                continue
            second.write_bytes(path.read_bytes())
            with pytest.raises(DataError) as caught:
                DATASETS.build(kind, root, offered={}, options={}).frame_ids()
            assert_one_line(caught.value)
            assert path.name in str(caught.value)
            assert second.name in str(caught.value)
            second.unlink()


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg", ".JPG", ".PNG"])
def test_images_may_be_png_or_jpeg_in_any_letters(
    request: pytest.FixtureRequest, dataset, root: Path, suffix: str
) -> None:
    """Also a mixture of them."""
    kind = request.node.callspec.params["root"]
    if kind == "nuscenes":
        pytest.skip("its tables contain the file of each frame")
    names = dataset.frame_ids()
    for name in names[1:3]:
        path = dataset.files(name).image
        found, content = cv2.imencode(suffix.lower(), cv2.imread(str(path)))
        assert found
        path.unlink()
        path.with_suffix(suffix).write_bytes(content.tobytes())
    again = DATASETS.build(kind, root, offered={}, options={})
    assert again.frame_ids() == names
    for name in names:
        size = dataset.read(names[0]).image_size
        assert again.read(name, image=True).image.shape[1::-1] == size


def test_the_layout_of_the_points_can_be_declared(
    request: pytest.FixtureRequest, dataset, root: Path
) -> None:
    """Columns in another order, with another scale of the intensities."""
    kind = request.node.callspec.params["root"]
    name = next(each for each in dataset.frame_ids() if dataset.files(each).points.suffix == ".bin")
    path, points = dataset.files(name).points, dataset.read(name).points
    if kind == "nuscenes":
        points[:, :2] = np.column_stack([-points[:, 1], points[:, 0]])  # its LiDAR looks along y
    if kind == "folder":
        description = root / "dataset.toml"
        description.write_text(description.read_text().replace("intensity_scale = 255", ""))
    scaled = points * np.float32([1, 1, 1, 50])
    np.column_stack([np.arange(len(points)), scaled[:, ::-1]]).astype("<f4").tofile(path)
    columns = ("ring", "intensity", "z", "y", "x")
    layout = PointLayout(column_names=columns, intensity_scale=50)
    declared = DATASETS.build(kind, root, offered={"layout": lambda: layout}, options={})
    found, expected = declared.read(name).points, in_lidar_frame(points, kind)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    with pytest.raises(DataError):
        DATASETS.build(kind, root, offered={}, options={}).read(name)


def in_lidar_frame(points: np.ndarray, kind: str) -> np.ndarray:
    """Return points of a file in the LiDAR frame of the data set."""
    if kind != "nuscenes":
        return points
    return np.column_stack([points[:, 1], -points[:, 0], points[:, 2:]])


def test_a_folder_without_a_dataset_is_rejected(
    request: pytest.FixtureRequest, dataset, tmp_path: Path
) -> None:
    """The DataError is one line that contains the folder."""
    (tmp_path / "nothing").mkdir()
    name = request.node.callspec.params["root"]
    with pytest.raises(DataError, match="nothing") as caught:
        DATASETS.build(name, tmp_path / "nothing", offered={}, options={}).frame_ids()
    assert_one_line(caught.value)


def test_copies_are_a_data_set_of_the_same_frames(dataset, tmp_path: Path) -> None:
    """Turned copies have the pixels of the frames, and their images; untouched ones are equal."""
    names = dataset.frame_ids()
    similarities = dict(zip(names, (TURNED, None), strict=False)) | dict.fromkeys(names[2:], TURNED)
    again, _ = copied(dataset, tmp_path / "copies", similarities)
    assert again.frame_ids() == names
    for name, similarity in similarities.items():
        frame, copy = (each.read(name, image=True) for each in (dataset, again))
        assert_is_copy(copy, frame, similarity or Similarity())
        np.testing.assert_array_equal(copy.image, frame.image)


def test_copies_contain_no_ground_truth(dataset, tmp_path: Path) -> None:
    """Neither label files nor annotations: the copies may be of unlabeled frames."""
    names = dataset.frame_ids()
    again, _ = copied(dataset, tmp_path / "copies", dict.fromkeys(names))
    for name in names:
        try:
            assert len(again.annotations(name)) == 0
        except DataError as error:
            assert_one_line(error)
