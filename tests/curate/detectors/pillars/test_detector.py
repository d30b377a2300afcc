"""The detector: ONNX Runtime and torch agree, and unusual frames work."""

import numpy as np
import onnxruntime
import pytest
import torch

from curate.detectors.pillars import PillarDetector
from curate.detectors.pillars.checkpoint import graph_path, load_checkpoint, save_checkpoint
from curate.detectors.pillars.detector import onnx_forward, torch_forward
from curate.detectors.pillars.encoding import encode_points
from curate.detectors.pillars.network import PillarNetwork, SlotMaximum, checkpoint_of
from curate.detectors.pillars.presets import PRESETS
from curate.errors import ConfigError
from curate.frames import Calibration, Frame
from curate.geometry.overlap import bev_iou

NAMES = ("Car", "Pedestrian", "Cyclist")


def lively(name):
    """Return a checkpoint with batch norms and outputs far from their initial values."""
    generator = torch.Generator().manual_seed(0)
    network = PillarNetwork(PRESETS[name], len(NAMES))
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d):
                module.running_mean.uniform_(-0.1, 0.1, generator=generator)
                module.running_var.uniform_(0.2, 1.0, generator=generator)
                module.weight.uniform_(0.5, 1.5, generator=generator)
                module.bias.uniform_(-0.2, 0.2, generator=generator)
        for tensor in network.parameters():
            if tensor.dim() > 1:
                tensor.normal_(0, (2 / tensor[0].numel()) ** 0.5, generator=generator)
        network.answer.weight.mul_(0.1)
    return checkpoint_of(network, NAMES)


def frame_of(points):
    """Return a frame with these points and an arbitrary camera."""
    return Frame("000000", points, Calibration(np.eye(3, 4), np.eye(4)), (100, 100))


def cloud(count, seed=0):
    """Return (count, 4) points all over the small grid."""
    rng = np.random.default_rng(seed)
    low, high = [0, -32, -2, 0], [64, 32, 1, 1]
    return rng.uniform(low, high, (count, 4)).astype(np.float32)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Return the file of a small checkpoint with random statistics."""
    path = tmp_path_factory.mktemp("checkpoints") / "small.safetensors"
    save_checkpoint(path, lively("small"))
    return path


@pytest.mark.parametrize(
    ("preset", "count"), [("small", 1), ("small", 3), ("small", 4000), ("kitti", 4000)]
)
def test_onnx_runtime_and_torch_agree(tmp_path, preset, count):
    """Scores, codes and IoU of the two agree to 1e-4, for any number of points."""
    path, checkpoint = tmp_path / "net.safetensors", lively(preset)
    save_checkpoint(path, checkpoint)
    pillars = encode_points(cloud(count), PRESETS[preset])
    (by_onnx,) = onnx_forward(path, checkpoint, 1)([pillars])
    (by_torch,) = torch_forward(path, checkpoint, "cpu")([pillars])
    assert by_onnx[0].shape == (*PRESETS[preset].cells, 3)
    assert by_onnx[2].shape == PRESETS[preset].cells
    assert np.ptp(by_torch[1]) > 0.1
    for ours, theirs in zip(by_onnx, by_torch, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


def test_a_batch_finds_the_boxes_of_each_frame(small):
    """To the last bit in ONNX Runtime; a frame may be empty."""
    empty = np.zeros((0, 4), dtype=np.float32)
    frames = [frame_of(each) for each in (cloud(900), empty, cloud(700, 1))]
    detector = PillarDetector(small, minimum_score=0.001)
    expected = [detector.predict(frame) for frame in frames]
    assert [len(each) > 0 for each in expected] == [True, False, True]
    for found, alone in zip(detector.predict_batch(frames), expected, strict=True):
        np.testing.assert_array_equal(found.boxes, alone.boxes)
    assert detector.predict_batch([]) == []


def test_frames_of_a_batch_do_not_change_each_other_in_torch(small):
    """As on a GPU: one pass for all of them, equal up to rounding."""
    frames = [encode_points(cloud(count, count), PRESETS["small"]) for count in (900, 1, 300)]
    forward = torch_forward(small, load_checkpoint(small), "cpu")
    for together, pillars in zip(forward(frames), frames, strict=True):
        for found, alone in zip(together, forward([pillars])[0], strict=True):
            np.testing.assert_allclose(found, alone, rtol=1e-4, atol=1e-5)
    assert forward([]) == []


@pytest.mark.parametrize(("precision", "digits"), [("bfloat16", 0.05), ("float16", 0.01)])
def test_mixed_precision_finds_about_the_same(small, precision, digits):
    """In torch, also on the CPU."""
    pillars = [encode_points(cloud(900), PRESETS["small"])]
    exact, rough = (
        torch_forward(small, load_checkpoint(small), "cpu", each)(pillars)[0][0]
        for each in ("float32", precision)
    )
    assert rough.dtype == np.float32
    assert 0 < np.abs(rough - exact).max() < digits
    detector = PillarDetector(small, minimum_score=0.001, precision=precision)
    assert len(detector.predict(frame_of(cloud(900)))) > 0
    with pytest.raises(ConfigError, match="unknown precision 'half'"):
        PillarDetector(small, precision="half")


def test_a_gpu_gets_batches_and_the_cpu_single_frames():
    assert PillarDetector.batch_size("cpu") == 1
    assert PillarDetector.batch_size("cuda") == PillarDetector.batch_size("mps") == 8


def test_an_empty_frame_has_no_detections(small):
    """No points, or none on the grid."""
    detector = PillarDetector(small)
    assert len(detector.predict(frame_of(np.zeros((0, 4), dtype=np.float32)))) == 0
    behind = np.array([[-5, 0, 0, 0]], dtype=np.float32)
    assert len(detector.predict(frame_of(behind))) == 0


def test_detections_are_sorted_and_do_not_overlap_within_a_category(small):
    """After NMS, boxes of a category overlap at most by the threshold."""
    detector = PillarDetector(small, minimum_score=0.0, nms_iou=0.3)
    found = detector.predict(frame_of(cloud(3000)))
    assert len(found) > 10
    assert (np.diff(found.scores) <= 0).all()
    for name in NAMES:
        boxes = found.boxes[found.categories == name]
        overlap = bev_iou(boxes, boxes)
        np.fill_diagonal(overlap, 0)
        assert overlap.max(initial=0) <= 0.3


def test_the_minimum_score_selects_detections(small):
    """A higher threshold keeps the better part of the same detections."""
    frame = frame_of(cloud(3000))
    everything = PillarDetector(small, minimum_score=0.0).predict(frame)
    middle = float(np.median(everything.scores))
    better = PillarDetector(small, minimum_score=middle).predict(frame)
    assert 0 < len(better) < len(everything)
    assert better.scores.min() >= middle


def test_a_missing_or_outdated_graph_is_exported_again(small):
    """The checkpoint defines the model: a missing or different graph is replaced."""
    frame = frame_of(cloud(500))
    expected = PillarDetector(small, minimum_score=0.0).predict(frame)
    graph = graph_path(small)
    for spoil in (graph.unlink, lambda: graph.write_bytes(b"no graph")):
        spoil()
        again = PillarDetector(small, minimum_score=0.0).predict(frame)
        np.testing.assert_array_equal(again.boxes, expected.boxes)
    save_checkpoint(small.with_name("other.safetensors"), lively("kitti"))
    small.with_name("other.onnx").replace(graph)
    again = PillarDetector(small, minimum_score=0.0).predict(frame)
    np.testing.assert_array_equal(again.boxes, expected.boxes)


def test_an_unknown_device_is_a_configuration_error(small):
    for device in ("toaster", "cuda:99"):
        with pytest.raises(ConfigError, match=device):
            PillarDetector(small, device=device)


def test_the_slot_maximum_has_the_gradient_of_scatter_reduce():
    """Without ties the gradient is that of autograd, for slots with no, one and several points."""
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(20, 3, generator=generator, requires_grad=True)
    slots = torch.randint(0, 6, (20,), generator=generator)
    weights = torch.rand(8, 3, generator=generator)
    (SlotMaximum.apply(values, slots, 8) * weights).sum().backward()
    ours = values.grad.clone()
    values.grad = None
    index = slots[:, None].expand(-1, 3)
    (torch.zeros(8, 3).scatter_reduce(0, index, values, "amax") * weights).sum().backward()
    torch.testing.assert_close(ours, values.grad)


def test_cells_without_points_are_those_of_an_empty_canvas():
    """The network computes only cells with points: maps and gradients are those of all cells."""
    generator = torch.Generator().manual_seed(0)
    network = PillarNetwork(PRESETS["small"], 1)
    features = torch.rand(400, 9, generator=generator)
    slots = torch.randint(0, 8 * 80 * 100, (400,), generator=generator)
    weights = torch.rand(2, 32, 80, 100, generator=generator)
    seen = []
    network.stem_norm.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    network(features, slots, 2)
    canvas = SlotMaximum.apply(network.points(features), slots, 8 * 80 * 100)
    seen.append(network.stem(canvas.view(2, 80, 100, -1).permute(0, 3, 1, 2)))
    parameters = [*network.points.parameters(), *network.stem.parameters()]
    ours, dense = (torch.autograd.grad((maps * weights).sum(), parameters) for maps in seen)
    torch.testing.assert_close(seen[0], seen[1])
    torch.testing.assert_close(ours, dense, rtol=1e-4, atol=1e-4)


def test_the_height_of_the_sensor_does_not_matter(small):
    """Heights are measured from the ground: the scores stay, the boxes move with the points."""
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform([0, -32], [51, 32], (4000, 2)), np.full(4000, -1.75)])
    points = np.concatenate([np.column_stack([ground, np.zeros(4000)]), cloud(4000)])
    points[:, 2] = np.maximum(points[:, 2], -1.75)
    detector = PillarDetector(small, minimum_score=0.001)
    best = np.arange(10)
    found = detector.predict(frame_of(points.astype(np.float32))).select(best)
    lower = detector.predict(frame_of((points - [0, 0, 0.5, 0]).astype(np.float32))).select(best)
    np.testing.assert_allclose(lower.scores, found.scores, rtol=1e-3)
    np.testing.assert_allclose(lower.boxes, found.boxes - [0, 0, 0.5, 0, 0, 0, 0], atol=1e-3)


def test_the_exported_model_is_the_graph_of_the_checkpoint(small, tmp_path):
    """In a file of its own, with a description of its inputs and outputs."""
    output = tmp_path / "folder" / "model.onnx"
    usage = PillarDetector.export_onnx(small, output, {})
    assert usage[-1] == "of preset small with categories Car, Pedestrian, Cyclist"
    checkpoint = load_checkpoint(small)
    pillars = encode_points(cloud(500), checkpoint.preset)
    inputs = {"features": pillars.features, "slots": pillars.slots[:, None]}
    session = onnxruntime.InferenceSession(output)
    scores, codes, ious = session.run(["scores", "codes", "ious"], inputs)
    [expected] = onnx_forward(small, checkpoint, 1)([pillars])
    for found, wanted in zip((scores, codes, ious[..., 0]), expected, strict=True):
        np.testing.assert_array_equal(found, wanted)
