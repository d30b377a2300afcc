"""Training: targets, losses and gradients against OpenPCDet's numbers, and the weights v."""

import copy
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from support.openpcdet_files import random_network, sweep, write_files

from curate.detections import CATEGORIES
from curate.detectors.base import Sample
from curate.detectors.openpcdet import targets as targets_module
from curate.detectors.openpcdet import training as training_module
from curate.detectors.openpcdet.anchors import anchor_classes, decode, encode
from curate.detectors.openpcdet.checkpoint import load_network
from curate.detectors.openpcdet.inference import detect
from curate.detectors.openpcdet.kernels import match_rectangles
from curate.detectors.openpcdet.loss import anchor_loss, corner_loss, roi_loss
from curate.detectors.openpcdet.network import Batch
from curate.detectors.openpcdet.presets import PRESETS, preset_file
from curate.detectors.openpcdet.roi_head import refine
from curate.detectors.openpcdet.schema import parse_model_file
from curate.detectors.openpcdet.targets import (
    Objects,
    anchor_targets,
    match_anchors,
    roi_targets,
    sample_rois,
    upright_rectangles,
)
from curate.detectors.openpcdet.training import AnchorStudent
from curate.detectors.openpcdet.voxels import make_voxels
from curate.detectors.whole_batch import batch_split
from curate.errors import ConfigError
from curate.geometry.overlap import bev_iou
from curate.training.batch_norm import normalise_whole_batches

# Tolerances of the oracle's README.
LOGITS, TARGETS, LOSSES, GRADIENTS, ENTRIES = 1e-4, 1e-5, 2e-5, 2e-4, 1e-3


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Sum in one order, as a training with its default settings does.

    Two threads add the gradient of a convolution's bias in another order, which changes its norm
    by up to 4e-4.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


class Scene:
    """OpenPCDet's training batch with its network in training mode, without dropout."""

    def __init__(self, oracle: Path, kitti: Path, name: str, numbers: str) -> None:
        self.expected = np.load(oracle / f"{numbers}.npz")
        self.network, _ = load_network(oracle / f"{name}.pth", oracle / f"{name}.yaml")
        self.file = self.network.file
        self.network.train()
        for module in self.network.modules():
            if isinstance(module, torch.nn.Dropout):
                module.eval()
        sweeps = []
        for i, frame in enumerate(self.expected["frames"]):
            path = kitti / f"training/velodyne/{frame}.bin"
            points = np.fromfile(path, dtype=np.float32).reshape(-1, 4)
            mask = np.unpackbits(self.expected[f"frame{i}_point_mask_packed"])[: len(points)]
            sweeps.append(points[mask.astype(bool)])
        self.batch = Batch.of(make_voxels(sweeps, self.file.data_config, training=True))
        self.objects = [
            Objects(rows[:, :7], rows[:, 7].astype(np.int64) - 1, np.ones(len(rows), np.float32))
            for rows in (each[each[:, 7] > 0] for each in self.expected["gt_boxes"])
        ]

    def roi_targets(self):
        """Return the targets of the proposals that OpenPCDet sampled."""
        rois = torch.from_numpy(self.expected["rois"])
        boxes = torch.from_numpy(self.expected["roi_gt_of_rois_src"])[..., :7]
        count = rois.shape[1]
        return roi_targets(
            rois.flatten(0, 1),
            torch.arange(len(rois)).repeat_interleave(count),
            torch.from_numpy(self.expected["roi_gt_iou_of_rois"]).flatten(),
            boxes.flatten(0, 1),
            torch.ones(len(rois) * count),
            self.file.model.roi_head.target_config,
        )


@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        ("pointpillar", "pointpillar_train"),
        ("voxel_rcnn_car", "voxel_rcnn_car_train_b"),
        pytest.param("second", "second_train", marks=pytest.mark.slow),
        pytest.param("voxel_rcnn_car", "voxel_rcnn_car_train", marks=pytest.mark.slow),
        pytest.param("voxel_rcnn_3class", "voxel_rcnn_3class_train", marks=pytest.mark.slow),
    ],
)
def test_targets_losses_and_gradients_equal_openpcdet(
    openpcdet_oracle: Path, kitti_root: Path, name: str, numbers: str
) -> None:
    """Also the running statistics of every batch norm."""
    scene = Scene(openpcdet_oracle, kitti_root, name, numbers)
    network, file, expected = scene.network, scene.file, scene.expected
    anchors, classes = network.anchors.numpy(), anchor_classes(file)
    labels = [match_anchors(anchors, classes, file, each).labels for each in scene.objects]
    assert np.array_equal(labels, expected["anchor_labels"])
    targets = anchor_targets(anchors, classes, file, scene.objects)
    positives = torch.stack([targets.rows, targets.anchors], dim=1)
    assert np.array_equal(positives, expected["positive_index"])
    assert_allclose(targets.codes, expected["positive_reg_targets"], rtol=0, atol=TARGETS)
    stage = network(scene.batch)
    index = torch.from_numpy(expected["anchor_index"])
    for key, found in (
        ("cls", stage.class_logits),
        ("box", stage.codes),
        ("dir_cls", stage.direction_logits),
    ):
        wanted = expected[f"train_{key}_preds"]
        assert_allclose(found[:, index].detach(), wanted, rtol=0, atol=LOGITS, err_msg=key)
    terms = anchor_loss(stage, targets, file.model.dense_head)
    if file.model.roi_head is not None:
        terms |= second_stage(scene, stage)
    for key, term in terms.items():
        assert term.item() == pytest.approx(float(expected[f"loss_{key}"]), rel=LOSSES), key
    total = torch.stack(list(terms.values())).sum()
    assert total.item() == pytest.approx(float(expected["loss_total"]), rel=LOSSES)
    check_gradients(network, total, expected)
    modules = dict(network.named_modules())
    for moment in ("mean", "var"):
        norms = [getattr(modules[key], f"running_{moment}").norm() for key in expected["bn_names"]]
        assert_allclose(norms, expected[f"bn_running_{moment}_norm_after"], rtol=1e-5)


def second_stage(scene: Scene, stage) -> dict[str, torch.Tensor]:
    """Check targets and outputs of the second stage; return its terms."""
    expected, head, targets = scene.expected, scene.file.model.roi_head, scene.roi_targets()
    wanted = expected["rcnn_cls_labels"].ravel()
    assert_allclose(targets.scores, wanted, rtol=0, atol=TARGETS)
    refined = np.flatnonzero(expected["reg_valid_mask"].ravel())
    assert np.array_equal(targets.refined, refined)
    codes_wanted = expected["rcnn_reg_targets"][refined]
    assert_allclose(targets.codes, codes_wanted, rtol=0, atol=TARGETS)
    logits, codes = scene.network.roi_head(targets.rois, targets.frames, stage.levels)
    assert_allclose(logits.detach(), expected["rcnn_cls"][:, 0], rtol=0, atol=LOGITS)
    assert_allclose(codes.detach(), expected["rcnn_reg"], rtol=0, atol=LOGITS)
    return roi_loss(logits, codes, targets, head)


def check_gradients(network, total: torch.Tensor, expected) -> None:
    """Check the norm and some entries of every parameter's gradient."""
    parameters = dict(network.named_parameters())
    names = expected["param_names"].tolist()
    assert sorted(names) == sorted(parameters)
    gradients = torch.autograd.grad(total, [parameters[name] for name in names])
    for row, (name, gradient) in enumerate(zip(names, gradients, strict=True)):
        norm = gradient.double().norm().item()
        assert norm == pytest.approx(expected["grad_norm_total"][row], rel=GRADIENTS), name
        index = expected["grad_sample_index"][row]
        wanted = expected["grad_sample_total"][row][index >= 0]
        found = gradient.flatten()[index[index >= 0]]
        limit = ENTRIES * gradient.abs().max().item()
        assert_allclose(found, wanted, rtol=0, atol=limit, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        ("pointpillar", "pointpillar_train"),
        ("second", "second_train"),
        ("voxel_rcnn_car", "voxel_rcnn_car_train_b"),
    ],
)
def test_three_steps_equal_openpcdets_optimiser(
    openpcdet_oracle: Path, kitti_root: Path, name: str, numbers: str
) -> None:
    """Adam with decoupled weight decay, its schedule of rate and momentum, clipped gradients."""
    scene = Scene(openpcdet_oracle, kitti_root, name, numbers)
    network, expected = scene.network, np.load(openpcdet_oracle / f"{name}_steps.npz")
    anchors, classes = network.anchors.numpy(), anchor_classes(scene.file)
    targets = anchor_targets(anchors, classes, scene.file, scene.objects)
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=0.01)
    names = expected["loss_names"].tolist()
    for step, tolerance in enumerate((1e-5, 2e-3, 1e-2)):
        optimizer.param_groups[0]["lr"] = float(expected["schedule_lr"][step])
        optimizer.param_groups[0]["betas"] = (float(expected["schedule_momentum"][step]), 0.99)
        stage = network(scene.batch)
        terms = anchor_loss(stage, targets, scene.file.model.dense_head)
        if scene.file.model.roi_head is not None:
            given = scene.roi_targets()
            outputs = network.roi_head(given.rois, given.frames, stage.levels)
            terms |= roi_loss(*outputs, given, scene.file.model.roi_head)
        total = torch.stack(list(terms.values())).sum()
        wanted = expected["losses_per_step"][step]
        assert total.item() == pytest.approx(wanted[names.index("total")], rel=tolerance)
        optimizer.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 10)
        optimizer.step()
    parameters = dict(network.named_parameters())
    norms = [parameters[key].detach().norm() for key in expected["param_names"]]
    assert_allclose(norms, expected["param_norm_after_3"], rtol=2e-3)


def sample(boxes, categories, weights, zero_weight="ignore") -> Sample:
    """Return a training frame."""
    rows = np.array(boxes, dtype=np.float64).reshape(-1, 7)
    names = np.array(categories, dtype=np.str_)
    return Sample(
        "0", False, sweep(), rows, names, np.array(weights, dtype=np.float64), zero_weight
    )


CAR, WALKER = (20.0, 3.0, -1.0, 4.2, 1.7, 1.5, 0.4), (12.0, -4.0, -0.9, 0.8, 0.7, 1.7, 2.0)


def student_of(name: str, seed: int = 0) -> AnchorStudent:
    """Return a student with random weights and no dropout."""
    network = random_network(name, seed).train()
    for module in network.modules():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.0
    return AnchorStudent(network, "")


@pytest.mark.parametrize("name", ["PointPillar", "SECONDNet", "VoxelRCNN"])
def test_v_multiplies_every_term_of_its_object(name: str) -> None:
    """The first stage's loss is affine in v; box and direction terms are proportional to it."""
    student, losses = student_of(name), {}
    for v in (0.25, 0.5, 1.0):
        batch = student.encode([sample([CAR, WALKER], ["Car", "Pedestrian"], [v, 1])], "cpu")
        stage = student.network(batch.voxels)
        terms = anchor_loss(stage, batch.targets, student.network.file.model.dense_head)
        losses[v] = {key: term.item() for key, term in terms.items()}
    for key in losses[1.0]:
        low, middle, high = (losses[v][key] for v in (0.25, 0.5, 1.0))
        assert low < middle < high
        assert middle - low == pytest.approx((high - low) / 3, rel=5e-3), key


def test_v_multiplies_the_terms_of_the_proposals_of_its_object() -> None:
    """The counts that normalise do not change with it."""
    student = student_of("VoxelRCNN")
    head = student.network.file.model.roi_head
    car = torch.tensor([CAR])
    rois = car + torch.tensor([[0.1, 0.1, 0, 0, 0, 0, 0.05], [0.6, 0, 0, 0, 0, 0, 0],
                               [9.0, 9, 0, 0, 0, 0, 0]])  # fmt: skip
    overlaps, boxes = torch.tensor([0.8, 0.6, 0.0]), car.expand(3, 7)
    logits, codes = torch.tensor([0.3, -0.2, 0.1]), torch.zeros(3, 7)
    found = []
    for v in (0.5, 1.0):
        targets = roi_targets(rois, torch.zeros(3, dtype=torch.int64), overlaps, boxes,
                              torch.full((3,), v), head.target_config)  # fmt: skip
        assert targets.weights.tolist() == [v, v, 1.0]
        assert targets.refined.tolist() == [0, 1]
        found.append(roi_loss(logits, codes, targets, head))
    half, full = found
    background = torch.nn.functional.softplus(logits[2]) / 3
    assert half["rcnn_loss_cls"] - background == pytest.approx(
        0.5 * (full["rcnn_loss_cls"] - background).item()
    )
    for key in ("rcnn_loss_reg", "rcnn_loss_corner"):
        assert half[key].item() == pytest.approx(0.5 * full[key].item())
        assert full[key] > 0


@pytest.mark.parametrize("name", ["PointPillar", "VoxelRCNN"])
def test_an_object_of_weight_0_is_neither_object_nor_background(name: str) -> None:
    """Its anchors get no gradient and are not counted; all others get the same as without it."""
    student = student_of(name)
    gradients = []
    for boxes, names, weights in (
        ([CAR, WALKER], ["Car", "Pedestrian"], [1, 0]),
        ([CAR], ["Car"], [1]),
    ):
        batch = student.encode([sample(boxes, names, weights)], "cpu")
        with torch.no_grad():
            stage = student.network(batch.voxels)
        stage = replace(stage, class_logits=stage.class_logits.requires_grad_())
        terms = anchor_loss(stage, batch.targets, student.network.file.model.dense_head)
        (gradient,) = torch.autograd.grad(terms["rpn_loss_cls"], stage.class_logits)
        gradients.append((gradient[0], batch.targets.counts.tolist()))
    (ignored, counts), (without, expected) = gradients
    changed = torch.nonzero((ignored != without).any(dim=1))[:, 0]
    assert counts == expected
    assert len(changed) > 0
    assert (ignored[changed] == 0).all()
    classes = anchor_classes(student.network.file)
    assert set(classes[changed.numpy()].reshape(-1).tolist()) == {CATEGORIES.index("Pedestrian")}


def test_proposals_at_an_ignore_region_are_not_sampled() -> None:
    """The others are: with an object of weight 1 instead, all of them can be."""
    config = random_network().file.model.roi_head.target_config
    rois = torch.tensor([CAR] * 8 + [[40.0, 10, -1, 4, 2, 1.5, 0]] * 8)
    classes = torch.zeros(16, dtype=torch.int64)
    for v in (0.0, 0.5):
        objects = Objects(np.array([CAR], np.float32), np.zeros(1, np.int64),
                          np.array([v], np.float32))  # fmt: skip
        targets = sample_rois(rois, classes, 0, objects, config)
        good = (targets.rois[:, 0] < 30).sum().item()
        assert good == (0 if v == 0 else config.roi_per_image * config.fg_ratio)
        assert len(targets.rois) == config.roi_per_image
        assert targets.box_weights.tolist() == [v] * good


@pytest.mark.parametrize("name", ["PointPillar", "SECONDNet", "VoxelRCNN"])
@pytest.mark.parametrize("case", ["no objects", "no points", "outside", "all ignored"])
def test_awkward_frames_have_a_finite_loss_with_gradients(name: str, case: str) -> None:
    student = student_of(name)
    frame = sample([CAR], ["Car"], [1])
    changed = {
        "no objects": sample([], [], []),
        "no points": replace(frame, points=frame.points[:0]),
        "outside": sample([(500.0, *CAR[1:])], ["Car"], [1]),
        "all ignored": sample([CAR], ["Car"], [0]),
    }[case]
    terms = student.loss(student.encode([changed, changed], "cpu"), 3.0)
    terms["loss"].backward()
    assert all(torch.isfinite(term) for term in terms.values())
    gradients = [each.grad for each in student.network.parameters() if each.grad is not None]
    assert gradients
    assert all(torch.isfinite(each).all() for each in gradients)


@pytest.mark.parametrize("name", ["PointPillar", "SECONDNet", "VoxelRCNN"])
def test_the_loss_of_weights_that_have_diverged_is_nan(name: str) -> None:
    """The training ends with a message; without proposals, the second stage must not crash."""
    student = student_of(name)
    torch.nn.init.constant_(student.network.dense_head.conv_cls.bias, torch.nan)
    frame = sample([CAR], ["Car"], [1])
    assert torch.isnan(student.loss(student.encode([frame, frame], "cpu"), 3.0)["loss"])


def test_a_checkpoint_of_openpcdet_is_fine_tuned_with_its_model_file(tmp_path: Path) -> None:
    """It belongs to no preset, and is saved with the model file."""
    path = write_files(tmp_path)
    config = path.with_suffix(".yaml").rename(tmp_path / "elsewhere.yaml")
    student = AnchorStudent.load(path, config)
    assert (student.preset, student.categories) == ("", CATEGORIES)
    saved = tmp_path / "round-01.pth"
    student.save(saved, student.network.state_dict())
    assert AnchorStudent.load(saved).network.file == student.network.file


def test_training_repeats_bit_for_bit() -> None:
    results = []
    for _ in range(2):
        student = student_of("VoxelRCNN")
        torch.manual_seed(1)
        terms = student.loss(student.encode([sample([CAR], ["Car"], [1])] * 2, "cpu"), 1.0)
        terms["loss"].backward()
        results.append([each.grad for each in student.network.parameters()])
    assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))


class SharedSum:
    """The sum of a tensor over two threads, which stand for two processes."""

    def __init__(self) -> None:
        self.own = threading.local()
        self.parts = [torch.zeros(0), torch.zeros(0)]
        self.barrier = threading.Barrier(2, timeout=60)

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        self.parts[self.own.rank] = values
        self.barrier.wait()
        total = self.parts[0] + self.parts[1]
        self.barrier.wait()
        return total


@pytest.mark.parametrize("name", ["PointPillar", "SECONDNet", "VoxelRCNN"])
def test_a_batch_that_is_split_over_processes_has_the_same_loss_and_gradients(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Frames with one, two and no objects, on two processes; proposals are given, not drawn."""
    rois = torch.tensor([CAR, WALKER, (40.0, 9, -1, 4, 2, 1.5, 0)], dtype=torch.float64)
    given = (rois + 0.02, torch.tensor([0, 1, 0]), torch.zeros(3))
    monkeypatch.setattr(training_module, "proposals", lambda *_: given)
    monkeypatch.setattr(targets_module, "_drawn", np.resize)
    monkeypatch.setattr(torch, "randperm", torch.arange)
    frames = [
        sample([CAR], ["Car"], [0.5]),
        replace(sample([], [], []), points=sweep(1000, seed=1)),
        replace(sample([CAR, WALKER], ["Car", "Pedestrian"], [1, 0.25]), points=sweep(seed=2)),
    ]
    whole, shared = student_of(name), SharedSum()

    def learn(rank: int | None) -> tuple[dict[str, float], dict[str, torch.Tensor]]:
        student = copy.deepcopy(whole)
        normalise_whole_batches(student.network.double())
        shared.own.rank = rank
        own = frames if rank is None else (frames[:2], frames[2:])[rank]
        batch = student.encode(own, "cpu")
        batch = replace(batch, voxels=replace(batch.voxels, points=batch.voxels.points.double()))
        terms = student.loss(batch, 1.0)
        terms["loss"].backward()
        grads = {key: each.grad for key, each in student.network.named_parameters()}
        buffers = {key: each for key, each in student.network.named_buffers() if "running" in key}
        return {key: term.item() for key, term in terms.items()}, grads | buffers

    losses, expected = learn(None)
    with batch_split(shared), ThreadPoolExecutor(2) as pool:
        (one, first), (other, second) = pool.map(learn, range(2))
    for key, value in losses.items():
        assert one[key] + other[key] == pytest.approx(value, rel=1e-6), key
        assert value > 0, key
    for key, value in expected.items():
        found = first[key] if "running" in key else first[key] + second[key]
        assert_allclose(found, value, rtol=0, atol=1e-6 * value.abs().max().item(), err_msg=key)


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_model_files_for_any_known_categories(preset: str) -> None:
    """The public ones have the published grids; unknown categories are named."""
    file = preset_file(preset, ("Van", "Car"))
    assert file.class_names == ("Van", "Car")
    assert parse_model_file(document_of(file), "again") == file
    fine = (1408, 1600, 40)
    grids = {"second": fine, "voxel-rcnn": fine, "pointpillar": (432, 496, 1)}
    assert file.data_config.grid == grids.get(preset, file.data_config.grid)
    with pytest.raises(ConfigError, match="no anchor for category 'Horse'; there are anchors for"):
        preset_file(preset, ("Car", "Horse"))


@pytest.mark.parametrize(
    "preset",
    [each if "small" in each else pytest.param(each, marks=pytest.mark.slow) for each in PRESETS],
)
def test_every_preset_learns_a_step_and_detects(tmp_path: Path, preset: str) -> None:
    """The saved checkpoint gives the boxes of the network that was saved."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        student = AnchorStudent.new(preset, CATEGORIES)
        batch = student.encode([sample([CAR, WALKER], ["Car", "Pedestrian"], [1, 0.5])] * 2, "cpu")
        optimizer = torch.optim.SGD(student.network.parameters(), lr=1e-3)
        losses = []
        for _ in range(2):
            optimizer.zero_grad()
            losses.append(student.loss(batch, 2.0)["loss"])
            losses[-1].backward()
            optimizer.step()
    assert losses[1] < losses[0]
    path = tmp_path / "trained.pth"
    student.save(path, student.network.state_dict())
    loaded = AnchorStudent.load(path)
    assert (loaded.preset, loaded.categories) == (preset, CATEGORIES)
    for network in (student.network, loaded.network):
        network.eval()
    expected, found = (
        detect(each, sweep(), 0.0, "0") for each in (student.network, loaded.network)
    )
    assert len(found) > 0
    assert np.array_equal(found.boxes, expected.boxes)


def document_of(file) -> dict:
    """Return the content of a model file as it is written."""
    import json

    return json.loads(file.to_text())


def test_codes_are_decoded_to_the_same_boxes() -> None:
    generator = torch.Generator().manual_seed(0)
    boxes, anchors = torch.rand(2, 50, 7, generator=generator, dtype=torch.float64) * 4 + 0.1
    torch.testing.assert_close(decode(encode(boxes, anchors), anchors), boxes)
    rois = anchors.clone()
    torch.testing.assert_close(refine(torch.zeros(50, 7, dtype=torch.float64), rois), rois)


def test_the_nearest_bev_iou_is_the_bev_iou_of_aligned_boxes() -> None:
    """Also if a box is turned by a multiple of 90 degrees and a bit less than 45."""
    rng = np.random.default_rng(0)
    boxes = rng.uniform(0.5, 5, (30, 7)).astype(np.float32)
    quarter = rng.integers(-4, 5, 30) * np.pi / 2
    aligned, tilted = boxes.copy(), boxes.copy()
    aligned[:, 6] = quarter
    tilted[:, 6] = quarter + rng.uniform(-0.7, 0.7, 30)
    expected = bev_iou(aligned.astype(np.float64), aligned.astype(np.float64))
    upright = upright_rectangles(aligned)
    for k in range(30):  # the IoU with one object at a time
        _, found, _ = match_rectangles(upright_rectangles(tilted), upright[k : k + 1])
        assert_allclose(found, expected[:, k], atol=1e-5)


def test_rectangles_match_the_object_that_they_overlap_most() -> None:
    """All rectangles with the largest IoU of an object are its best; none if nothing overlaps."""
    rng = np.random.default_rng(1)
    low = rng.integers(0, 12, (60, 2))
    rectangles = np.concatenate([low, low + rng.integers(1, 5, (60, 2))], axis=1)
    objects = np.concatenate([rectangles[:6] + 1, [[90, 90, 91, 91]]])
    boxes = [
        np.column_stack([(each[:, :2] + each[:, 2:]) / 2, np.zeros(len(each)),
                         each[:, 2:] - each[:, :2], np.ones(len(each)), np.zeros(len(each))])
        for each in (rectangles, objects)
    ]  # fmt: skip
    overlap = bev_iou(*boxes)
    best, most, is_highest = match_rectangles(
        rectangles.astype(np.float32), objects.astype(np.float32)
    )
    assert_allclose(most, overlap.max(axis=1), atol=1e-6)
    assert_array_equal(best, overlap.round(6).argmax(axis=1))
    highest = overlap.max(axis=0)
    expected = (np.isclose(overlap, highest) & (highest > 0)).any(axis=1)
    assert_array_equal(is_highest, expected)
    assert expected.sum() > 6


def test_the_corner_loss_is_0_for_the_same_box_and_for_the_opposite_heading() -> None:
    box = torch.tensor([CAR])
    opposite = box + torch.tensor([0, 0, 0, 0, 0, 0, torch.pi])
    moved = box + torch.tensor([[0.5, 0, 0, 0, 0, 0, 0]])
    assert corner_loss(box, box).item() == 0
    assert corner_loss(opposite, box).item() == pytest.approx(0, abs=1e-9)
    assert corner_loss(moved, box).item() == pytest.approx(0.125)  # Huber: 0.5^2 / 2
