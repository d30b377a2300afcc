"""What every registered detector promises."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from contracts.samples import assert_one_line, assert_same, sample_of
from support.tiny_onnx import tiny_detector

from curate.detections import CATEGORIES, Detections
from curate.detectors.base import RecordedViews
from curate.detectors.pillars.checkpoint import save_checkpoint
from curate.detectors.pillars.network import PillarNetwork, checkpoint_of
from curate.detectors.pillars.presets import PRESETS
from curate.errors import DataError, ModelError
from curate.frames import Frame
from curate.geometry.similarity import Similarity
from pipelines.registry import DETECTORS


def write_checkpoint(folder: Path, frames: Sequence[Frame]) -> Path:
    """An untrained network that answers boxes of all scores."""
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
    """Six boxes for each frame as it is and for a copy of it."""
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
    """A graph that answers two boxes per category around the mean of the points."""
    path = folder / "model.onnx"
    tiny_detector(path, boxes_per_category=2)
    return path


# Writes the file from which the detector is made, fit for some frames.
SAMPLES: Mapping[str, Callable[[Path, Sequence[Frame]], Path]] = {
    "pillars": write_checkpoint,
    "recorded": write_record,
    "onnx": write_onnx,
}


def build(name: str, path: Path, minimum_score: float = 0.1):
    """A detector as the pipeline builds it."""
    offered = {
        "minimum_score": lambda: minimum_score,
        "device": lambda: "cpu",
        "categories": lambda: CATEGORIES,
        "threads": lambda: 1,
    }
    return DETECTORS.build(name, path, offered=offered, options={})


@pytest.fixture(scope="module", params=sorted(DETECTORS.classes))
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, frames):
    """Name and file of every registered detector."""
    wanted = "a function that writes a small file from which the detector can be made"
    write = sample_of(SAMPLES, request.param, wanted)
    return request.param, write(tmp_path_factory.mktemp(request.param), frames)


@pytest.fixture(scope="module")
def detector(made):
    """Every registered detector with its default settings."""
    return build(*made)


def check(found: Detections) -> None:
    """Boxes, scores and categories are what the type says."""
    count = len(found)
    assert (found.boxes.shape, found.boxes.dtype) == ((count, 7), np.float64)
    assert (found.scores.shape, found.scores.dtype) == ((count,), np.float64)
    assert found.categories.shape == (count,)
    assert found.categories.dtype.kind == "U"
    assert np.isfinite(found.boxes).all()
    assert (found.boxes[:, 3:6] > 0).all()
    assert ((found.boxes[:, 6] > -np.pi) & (found.boxes[:, 6] <= np.pi)).all()
    assert ((found.scores >= 0) & (found.scores <= 1)).all()


def test_answers_are_boxes_scores_and_categories(detector, frames) -> None:
    """In their shapes, types and ranges, for every frame; some have boxes."""
    found = [detector.predict(frame) for frame in frames]
    for one in found:
        check(one)
    assert sum(map(len, found)) > 0


def test_answers_do_not_depend_on_what_was_asked_before(made, detector, frames) -> None:
    """Asked again, in another order, or of another instance: the same, to the last bit."""
    before = [detector.predict(frame) for frame in frames]
    other = build(*made)
    for frame, expected in reversed(list(zip(frames, before, strict=True))):
        assert_same(other.predict(frame), expected)
        assert_same(detector.predict(frame), expected)


def test_answers_do_not_depend_on_the_order_of_the_points(detector, frames) -> None:
    """A sweep is a set; sums may differ in their last digits."""
    order = np.random.default_rng(0).permutation(len(frames[0].points))
    expected = detector.predict(frames[0])
    found = detector.predict(frames[0].with_points(frames[0].points[order]))
    assert found.categories.tolist() == expected.categories.tolist()
    np.testing.assert_allclose(found.scores, expected.scores, atol=1e-5)
    np.testing.assert_allclose(found.boxes, expected.boxes, atol=1e-3)


def test_a_frame_is_left_as_it_is(detector, frames) -> None:
    """The next stage reads the same points."""
    frame = replace(frames[0], points=frames[0].points.copy())
    frame.points.flags.writeable = False
    detector.predict(frame)
    np.testing.assert_array_equal(frame.points, frames[0].points)


@pytest.mark.parametrize("count", [0, 1])
def test_a_sweep_of_hardly_any_points_is_not_a_failure(detector, frames, count: int) -> None:
    """Dropouts happen; the answer has the usual form."""
    check(detector.predict(frames[0].with_points(frames[0].points[:count])))


def test_low_scores_are_left_out_as_told(made, frames) -> None:
    """`minimum_score` includes its own value and changes nothing of what is above."""
    name, _ = made
    if not DETECTORS.takes(name, "minimum_score"):
        pytest.skip(f"{name} leaves this to the pipeline")
    everything = build(*made, minimum_score=0.0).predict(frames[0])
    limit = float(np.median(everything.scores))
    found = build(*made, minimum_score=limit).predict(frames[0])
    kept = np.sort(everything.scores[everything.scores >= limit])
    assert 0 < len(found) < len(everything)
    assert np.sort(found.scores).tolist() == kept.tolist()


def test_recorded_views_name_their_similarity(detector, frames) -> None:
    """A detector that dictates the augmentation gives each A with what it saw there."""
    if isinstance(detector, RecordedViews):
        views = detector.views(frames[0].frame_id)
        assert len(views) > 0
        for similarity, found in views:
            assert isinstance(similarity, Similarity)
            check(found)


@pytest.mark.parametrize("content", [None, b"", b"no detector \x00\xff\n"])
def test_a_file_that_is_not_a_detector_is_named(
    made, tmp_path: Path, content: bytes | None
) -> None:
    """Missing, empty or garbage: one line of the right class, never another exception."""
    name, path = made
    broken = tmp_path / f"broken{path.suffix}"
    if content is not None:
        broken.write_bytes(content)
    with pytest.raises((ModelError, DataError)) as caught:
        build(name, broken)
    assert_one_line(caught.value)
    assert broken.name in str(caught.value)
