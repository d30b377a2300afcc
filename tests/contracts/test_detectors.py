"""The contract of every registered detector."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from contracts.samples import assert_one_line, assert_same, sample_of
from support.external_detector import command_of, write_script
from support.openpcdet_files import write_files
from support.tiny_onnx import tiny_detector
from support.toys import write_toy_kitti

from curate.datasets.kitti.dataset import KittiDataset
from curate.detections import CATEGORIES, Detections
from curate.detectors.base import BatchDetector, CopiesDetector, RecordedViews
from curate.detectors.pillars.checkpoint import save_checkpoint
from curate.detectors.pillars.network import PillarNetwork, checkpoint_of
from curate.detectors.pillars.presets import PRESETS
from curate.errors import DataError, ModelError
from curate.frames import Frame
from curate.geometry.similarity import Similarity
from pipelines.registry import DETECTORS


def write_checkpoint(folder: Path, frames: Sequence[Frame]) -> Path:
    """Write the checkpoint of an untrained network that predicts boxes of all scores."""
    generator = torch.Generator().manual_seed(0)
    network = PillarNetwork(PRESETS["small"], len(CATEGORIES))
    with torch.no_grad():
        for tensor in network.parameters():
            if tensor.dim() > 1:
                tensor.normal_(0, (2 / tensor[0].numel()) ** 0.5, generator=generator)
        network.answer.bias.zero_()
        network.answer.weight.mul_(0.3)
    path = folder / "network.safetensors"
    save_checkpoint(path, checkpoint_of(network, CATEGORIES))
    return path


def write_record(folder: Path, frames: Sequence[Frame]) -> Path:
    """Write six boxes for each frame and for its augmented copy."""
    rng = np.random.default_rng(0)
    lines = [
        "frame,view,flip_y,rotation_rad,scale,category,score,x,y,z,length,width,height,yaw",
        *(
            f"{frame.frame_id},{view},{view},{0.2 * view},{1 + 0.02 * view},"
            f"{rng.choice(CATEGORIES)},{rng.random()},{rng.uniform(5, 30)},{rng.uniform(-9, 9)},"
            f"-0.8,4,1.8,1.5,{rng.uniform(-9, 9)}"
            for frame in frames
            for view in (0, 1)
            for _ in range(6)
        ),
    ]
    path = folder / "record.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def write_onnx(folder: Path, frames: Sequence[Frame]) -> Path:
    """Write a graph that predicts two boxes per category around the mean of the points."""
    path = folder / "model.onnx"
    tiny_detector(path, boxes_per_category=2)
    return path


def write_command(folder: Path, frames: Sequence[Frame]) -> Path:
    """Write a script that finds the objects of the test frames, and the frames as a data set."""
    write_toy_kitti(folder, frames=len(frames))
    return write_script(folder)


def write_openpcdet(folder: Path, frames: Sequence[Frame]) -> Path:
    """Write a checkpoint of a small Voxel R-CNN with its model file beside it."""
    return write_files(folder)


# Write the file from which the detector is created, for the test frames.
SAMPLES: Mapping[str, Callable[[Path, Sequence[Frame]], Path]] = {
    "pillars": write_checkpoint,
    "recorded": write_record,
    "onnx": write_onnx,
    "openpcdet": write_openpcdet,
    "command": write_command,
}
# Options that a detector needs besides, for its file.
OPTIONS: Mapping[str, Callable[[Path], Mapping[str, object]]] = {
    "command": lambda path: {"command": command_of(path)},
}


def build(name: str, path: Path, minimum_score: float = 0.1):
    """Return a detector as the pipeline builds it."""
    offered = {
        "minimum_score": lambda: minimum_score,
        "device": lambda: "cpu",
        "categories": lambda: CATEGORIES,
        "threads": lambda: 1,
        "open_dataset": lambda: lambda: KittiDataset(path.parents[1]),
        "folder": lambda: path.parent,
    }
    options = OPTIONS[name](path) if name in OPTIONS else {}
    return DETECTORS.build(name, path, offered=offered, options=options)


@pytest.fixture(scope="module", params=sorted(DETECTORS.classes))
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, frames):
    """Return the name and the file of every registered detector in turn."""
    description = "a function that writes a small file from which the detector can be made"
    write = sample_of(SAMPLES, request.param, description)
    return request.param, write(tmp_path_factory.mktemp(request.param), frames)


@pytest.fixture(scope="module")
def detector(made):
    """Return every registered detector with its default settings."""
    return build(*made)


def check_output(found: Detections) -> None:
    """Check shapes, types and ranges of boxes, scores and categories."""
    count = len(found)
    assert (found.boxes.shape, found.boxes.dtype) == ((count, 7), np.float64)
    assert (found.scores.shape, found.scores.dtype) == ((count,), np.float64)
    assert found.categories.shape == (count,)
    assert found.categories.dtype.kind == "U"
    assert np.isfinite(found.boxes).all()
    assert (found.boxes[:, 3:6] > 0).all()
    assert ((found.boxes[:, 6] > -np.pi) & (found.boxes[:, 6] <= np.pi)).all()
    assert ((found.scores >= 0) & (found.scores <= 1)).all()


def test_predictions_have_the_documented_shapes_and_ranges(detector, frames) -> None:
    """Every frame is checked; at least one has boxes."""
    found = [detector.predict(frame) for frame in frames]
    for one in found:
        check_output(one)
    assert sum(map(len, found)) > 0


def test_predictions_do_not_depend_on_earlier_calls(made, detector, frames) -> None:
    """A second call, another order or another instance gives the same boxes to the last bit."""
    before = [detector.predict(frame) for frame in frames]
    other = build(*made)
    for frame, expected in reversed(list(zip(frames, before, strict=True))):
        assert_same(other.predict(frame), expected)
        assert_same(detector.predict(frame), expected)


def test_the_boxes_of_a_frame_do_not_depend_on_its_batch(detector, frames) -> None:
    """A batch of one frame, several frames, and another order."""
    if not isinstance(detector, BatchDetector):
        pytest.skip("it takes one frame at a time")
    expected = [detector.predict(frame) for frame in frames]
    for order in ([0], [*range(len(frames))], [*reversed(range(len(frames)))]):
        found = detector.predict_batch([frames[i] for i in order])
        for i, each in zip(order, found, strict=True):
            assert_same(each, expected[i])


def test_predictions_do_not_depend_on_the_order_of_the_points(detector, frames) -> None:
    """Sums may differ in their last digits."""
    order = np.random.default_rng(0).permutation(len(frames[0].points))
    expected = detector.predict(frames[0])
    found = detector.predict(frames[0].with_points(frames[0].points[order]))
    assert found.categories.tolist() == expected.categories.tolist()
    np.testing.assert_allclose(found.scores, expected.scores, atol=1e-5)
    np.testing.assert_allclose(found.boxes, expected.boxes, atol=1e-3)


def test_the_input_frame_is_not_modified(detector, frames) -> None:
    frame = replace(frames[0], points=frames[0].points.copy())
    frame.points.flags.writeable = False
    detector.predict(frame)
    np.testing.assert_array_equal(frame.points, frames[0].points)


@pytest.mark.parametrize("count", [0, 1])
def test_a_sweep_with_few_points_does_not_fail(detector, frames, count: int) -> None:
    check_output(detector.predict(frames[0].with_points(frames[0].points[:count])))


def test_scores_below_the_minimum_are_dropped(made, frames) -> None:
    """`minimum_score` itself is kept, and the boxes above it do not change."""
    name, _ = made
    if not DETECTORS.takes(name, "minimum_score"):
        pytest.skip(f"{name} leaves this to the pipeline")
    everything = build(*made, minimum_score=0.0).predict(frames[0])
    limit = float(np.median(everything.scores))
    found = build(*made, minimum_score=limit).predict(frames[0])
    kept = np.sort(everything.scores[everything.scores >= limit])
    assert 0 < len(found) < len(everything)
    assert np.sort(found.scores).tolist() == kept.tolist()


def test_detectors_that_run_elsewhere_find_the_same_in_every_batch(detector, frames) -> None:
    """The boxes of a turned copy are in its own frame of reference."""
    if not isinstance(detector, CopiesDetector):
        pytest.skip("it runs in this process")
    names = [frame.frame_id for frame in frames]
    turned = Similarity(rotation_rad=0.5)
    together = detector.predict_copies(dict.fromkeys(names, turned), view=1)
    for name, frame, found in zip(names, frames, together, strict=True):
        check_output(found)
        assert_same(detector.predict_copies({name: turned}, view=1)[0], found)
        expected = turned.apply_to_boxes(detector.predict(frame).boxes)
        np.testing.assert_allclose(found.boxes[:, :3], expected[:, :3], atol=1e-4)


def test_recorded_detectors_report_the_similarity_of_each_view(detector, frames) -> None:
    """A detector that dictates the augmentation returns the similarity together with its boxes."""
    if isinstance(detector, RecordedViews):
        views = detector.views(frames[0].frame_id)
        assert len(views) > 0
        for similarity, found in views:
            assert isinstance(similarity, Similarity)
            check_output(found)


@pytest.mark.parametrize("content", [None, b"", b"no detector \x00\xff\n"])
def test_an_invalid_detector_file_is_rejected(made, tmp_path: Path, content: bytes | None) -> None:
    """A missing, empty or random file gives a one-line error of the right class."""
    name, path = made
    if name == "command":
        pytest.skip("only the command reads the file")
    broken = tmp_path / f"broken{path.suffix}"
    if content is not None:
        broken.write_bytes(content)
    with pytest.raises((ModelError, DataError)) as caught:
        build(name, broken)
    assert_one_line(caught.value)
    assert broken.name in str(caught.value)
