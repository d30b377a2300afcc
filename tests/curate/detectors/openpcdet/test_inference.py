"""Inference: every stage against OpenPCDet's numbers, and awkward sweeps."""

import hashlib
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from support.openpcdet_files import model_file, random_network, sweep, write_files

from curate.detectors.openpcdet import OpenPCDetDetector
from curate.detectors.openpcdet.checkpoint import load_network
from curate.detectors.openpcdet.inference import detect, proposals
from curate.detectors.openpcdet.network import Batch
from curate.detectors.openpcdet.pooling import NearMaximum, near_voxels
from curate.detectors.openpcdet.roi_head import refine
from curate.detectors.openpcdet.sparse import Sites
from curate.detectors.openpcdet.voxels import make_voxels
from curate.errors import ConfigError, DataError, ModelError
from curate.frames import Frame, calibration_without_camera
from curate.geometry.similarity import wrap_angle
from curate.warnings_once import warn_once

# Tolerances of the oracle's README: features and logits, boxes.
FEATURES, BOXES = 2e-4, 1e-4
NAMES = ("PointPillar", "SECONDNet", "VoxelRCNN")


def digest(rows: np.ndarray) -> str:
    """Return the SHA-256 of rows as int32."""
    return hashlib.sha256(np.ascontiguousarray(rows, dtype=np.int32).tobytes()).hexdigest()


def frame_of(points: np.ndarray) -> Frame:
    """Return a frame without a camera."""
    return Frame("000000", points, calibration_without_camera(), None)


@pytest.mark.parametrize(
    ("weights", "name", "frame"),
    [
        ("pointpillar", "pointpillar", "000008"),
        ("second_spconv1", "second", "000004"),
        ("voxel_rcnn_car", "voxel_rcnn_car", "000008"),
        pytest.param("second", "second", "000008", marks=pytest.mark.slow),
        pytest.param("second", "second", "000004", marks=pytest.mark.slow),
        pytest.param("voxel_rcnn_3class", "voxel_rcnn_3class", "000008", marks=pytest.mark.slow),
        pytest.param("voxel_rcnn_3class", "voxel_rcnn_3class", "000004", marks=pytest.mark.slow),
    ],
)
def test_every_stage_equals_openpcdet(
    openpcdet_oracle: Path, kitti_root: Path, weights: str, name: str, frame: str
) -> None:
    """Voxels, sparse levels, maps, anchors, proposals, pooling and the final boxes."""
    expected = np.load(openpcdet_oracle / f"{name}_eval_{frame}.npz")
    paths = (openpcdet_oracle / file for file in (f"{weights}.pth", f"{name}.yaml"))
    network, _ = load_network(*paths)
    path = kitti_root / f"training/velodyne/{frame}.bin"
    points = np.fromfile(path, dtype=np.float32).reshape(-1, 4)
    points = points[np.unpackbits(expected["point_mask_packed"])[: len(points)].astype(bool)]
    voxels = make_voxels([points], network.file.data_config)
    assert digest(voxels.places[:, 1:]) == expected["voxel_coords_sha256"]
    assert digest(voxels.counts) == expected["voxel_num_points_sha256"]
    with torch.inference_mode():
        stage = network(Batch.of(voxels))
        check_levels(stage.levels, expected)
        check_anchors(network, stage, expected)
        if network.file.model.roi_head is not None:
            check_second_stage(network, stage, expected)
    threshold = network.file.model.post_processing.score_thresh
    check_boxes(detect(network, points, threshold, frame), network, expected)
    lower = detect(network, points, threshold / 3, frame)
    kept = lower.select(lower.scores >= threshold)
    assert len(lower) > len(kept)
    check_boxes(kept, network, expected)


def check_levels(levels, expected) -> None:
    """Check the sites and features of the sparse backbone."""
    for name, tensor in levels.items():
        places = tensor.sites.places.numpy()
        key = f"sparse_{name}"
        assert tensor.sites.shape == tuple(expected[f"{key}_shape_zyx"])
        assert digest(places) == expected[f"{key}_sorted_coords_sha256"]
        wanted = expected[f"{key}_rows_coords_bzyx"]
        rows = [int(np.flatnonzero((places == each).all(axis=1))[0]) for each in wanted]
        assert_allclose(tensor.features[rows], expected[f"{key}_rows"], rtol=0, atol=FEATURES)
        sums = tensor.features.double().sum(dim=0)
        assert_allclose(sums, expected[f"{key}_channel_sums"], rtol=FEATURES)


def check_anchors(network, stage, expected) -> None:
    """Check the maps, the anchors and the outputs at some of them."""
    for name, maps in zip(("bev", "bev2d"), stage.maps, strict=True):
        assert maps.shape == tuple(expected[f"{name}_shape"])
        values = maps.flatten()[expected[f"{name}_sample_index"]]
        assert_allclose(values, expected[f"{name}_sample_value"], rtol=0, atol=FEATURES)
    index = torch.from_numpy(expected["anchor_index"])
    assert len(network.anchors) == expected["anchor_count"]
    for key, found, tolerance in (
        ("box", network.anchors[index], BOXES),
        ("cls_logits", stage.class_logits[0, index], FEATURES),
        ("box_deltas", stage.codes[0, index], FEATURES),
        ("dir_logits", stage.direction_logits[0, index], FEATURES),
        ("decoded_boxes", network.boxes_of(stage, 0, index), BOXES),
    ):
        assert_allclose(found, expected[f"anchor_{key}"], rtol=0, atol=tolerance, err_msg=key)


def check_second_stage(network, stage, expected) -> None:
    """Check proposals, pooled features, scores and refined boxes."""
    found, classes, _ = proposals(network, stage, 0, network.roi_head.config.nms_config.test)
    rois = torch.from_numpy(expected["rois"])
    pairs = [(found - roi).abs().amax(dim=1).min() for roi in rois]
    assert len(found) == len(rois)
    assert max(pairs) < BOXES
    assert torch.equal(classes.bincount(), torch.from_numpy(expected["roi_labels"] - 1).bincount())
    frames = torch.zeros(len(rois), dtype=torch.int64)
    pooled = network.roi_head.pooled(rois, frames, stage.levels)
    assert_allclose(pooled[:3], expected["roi_pooled_first3"], rtol=0, atol=FEATURES)
    sums = pooled.double().sum(dim=(1, 2))
    assert_allclose(sums, expected["roi_pooled_sum_per_roi"], rtol=FEATURES)
    logits, codes = network.roi_head(rois, frames, stage.levels)
    assert_allclose(logits, expected["rcnn_cls_logits"][:, 0], rtol=0, atol=FEATURES)
    assert_allclose(codes, expected["rcnn_reg"], rtol=0, atol=FEATURES)
    assert_allclose(refine(codes, rois), expected["refined_boxes"], rtol=0, atol=BOXES)


def check_boxes(found, network, expected) -> None:
    """Check final boxes by matching: 1 mm, and 1e-4 for scores."""
    boxes, names = expected["final_boxes"], np.array(network.file.class_names)
    categories = names[expected["final_labels"] - 1]
    away = found.boxes[:, None] - boxes
    away[..., 6] = wrap_angle(away[..., 6])
    away = np.abs(away).max(axis=2) + 9 * (found.categories[:, None] != categories)
    nearest = away.argmin(axis=0)
    assert sorted(nearest) == list(range(len(found)))
    assert away.min(axis=0).max() < 1e-3
    assert_allclose(found.scores[nearest], expected["final_scores"], rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("count", [0, 1, 2])
def test_sweeps_with_hardly_any_points_are_predicted(tmp_path, name: str, count: int) -> None:
    """Also one voxel alone."""
    detector = OpenPCDetDetector(write_files(tmp_path, name), minimum_score=0.0)
    found = detector.predict(frame_of(sweep()[:count]))
    assert np.isfinite(found.boxes).all()
    assert (len(found) > 0) == (count > 0)


def test_points_outside_the_range_have_no_boxes(tmp_path, caplog) -> None:
    """This is reported once, not for every frame."""
    warn_once.cache_clear()
    points = sweep()
    points[:, 0] += 1000
    detector = OpenPCDetDetector(write_files(tmp_path), minimum_score=0.0)
    with caplog.at_level(logging.WARNING):
        for name in ("1", "2"):
            assert len(detector.predict(replace(frame_of(points), frame_id=name))) == 0
    (message,) = caplog.messages
    assert message.startswith("some frames have no points in POINT_CLOUD_RANGE of the model file")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [1e38, 1e15])
def test_weights_that_overflow_are_reported(name: str, value: float) -> None:
    """NaN scores would silently be no boxes, and proposals far away must not crash the pooling."""
    network = random_network(name)
    with torch.no_grad():
        for key, each in network.named_parameters():
            if key.startswith("dense_head.conv_box") or (value > 1e30 and each.dim() > 1):
                each.fill_(value)
    if value > 1e30:
        with pytest.raises(ModelError, match="frame 7: the network computes NaN or infinite"):
            detect(network, sweep(), 0.1, "7")
    else:
        assert np.isfinite(detect(network, sweep(), 0.1, "7").boxes).all()


@pytest.mark.parametrize("cell", [-(2**63), 2**63 - 1, 2**40])
def test_no_voxel_is_near_a_cell_far_away(cell: int) -> None:
    """The cell of a coordinate that is NaN or huge can be any integer."""
    sites, _ = Sites.of(torch.zeros((1, 4), dtype=torch.int64), (4, 9, 8), 1)
    cells = torch.tensor([[0, cell, 0, 0], [0, 0, cell, 0], [0, 0, 0, cell], [0, cell, cell, cell]])
    far = torch.full((4, 3), 1e9)
    near = near_voxels(sites, torch.zeros(1, 3), cells, far, (1, 2, 3), 2.2, 3)
    assert (near == -1).all()


def test_more_voxels_than_the_cap_are_reported(tmp_path, caplog) -> None:
    """Once per process; the first voxels in the file are kept."""
    warn_once.cache_clear()
    path = write_files(tmp_path)
    config = path.with_suffix(".yaml")
    config.write_text(config.read_text().replace('"test": 40000', '"test": 500'))
    with caplog.at_level(logging.WARNING):
        detector = OpenPCDetDetector(path)
        detector.predict(replace(frame_of(sweep(seed=1)), frame_id="1"))
        found = detector.predict(frame_of(sweep()))
    assert len(caplog.messages) == 1
    assert "voxels; the model file keeps 500 (MAX_NUMBER_OF_VOXELS)" in caplog.messages[0]
    assert np.isfinite(found.boxes).all()


@pytest.mark.parametrize(
    ("value", "message"),
    [(np.nan, "without a finite intensity"), (255.0, "up to 255|to 255, the detector needs"),
     (-1.0, "from -1 to")],
)  # fmt: skip
def test_wrong_intensities_fail_the_frame(tmp_path, value: float, message: str) -> None:
    points = sweep()
    points[7, 3] = value
    with pytest.raises(DataError, match=f"frame 000000: .*{message}"):
        OpenPCDetDetector(write_files(tmp_path)).predict(frame_of(points))


def test_the_height_of_the_ground_is_checked_and_can_be_shifted(tmp_path, caplog) -> None:
    """A sensor on a higher roof: with its height given, the same boxes, at its own height."""
    path, points = write_files(tmp_path), sweep()
    higher = points - np.array([0, 0, 1, 0], dtype=np.float32)
    warn_once.cache_clear()
    with caplog.at_level(logging.WARNING):
        expected = OpenPCDetDetector(path).predict(frame_of(points))
        assert caplog.messages == []
        OpenPCDetDetector(path).predict(frame_of(higher))
        (message,) = caplog.messages
        assert message.startswith("the ground is 2.7 m below the LiDAR; the detector expects 1.73")
        assert message.endswith("set detector.options.lidar_height = 2.7")
        caplog.clear()
        found = OpenPCDetDetector(path, lidar_height=2.73).predict(frame_of(higher))
        assert caplog.messages == []
        raised = points + np.array([0, 0, 3.4, 0], dtype=np.float32)
        OpenPCDetDetector(path).predict(frame_of(raised))
        assert caplog.messages == ["the ground is 1.7 m above the origin of the points: is z up?"]
    assert len(found) == len(expected) > 0
    assert_allclose(found.boxes[:, 2], expected.boxes[:, 2] - 1, atol=1e-3)
    with pytest.raises(ConfigError, match="lidar_height"):
        OpenPCDetDetector(path, lidar_height=-1)


def test_voxels_equal_a_slow_reference() -> None:
    """Order of first appearance, caps of points and voxels, both ends of the range."""
    data = model_file().data_config
    points = np.concatenate([sweep(400), sweep(400)[::-1]])
    low, high = np.float32(data.point_cloud_range[:3]), np.float32(data.point_cloud_range[3:])
    points[0, :3], points[1, :3] = low, high
    cells = np.floor((points[:, :3] - low) / np.float32(data.voxels.voxel_size)).astype(int)
    expected: dict[tuple[int, ...], list[int]] = {}
    for i, cell in enumerate(cells):
        if (cell >= 0).all() and (cell < data.grid).all():
            expected.setdefault(tuple(cell[::-1].tolist()), []).append(i)
    found = make_voxels([points], data)
    assert list(map(tuple, found.places[:, 1:].tolist())) == list(expected)
    for voxel, index in enumerate(expected.values()):
        kept = index[: data.voxels.max_points_per_voxel]
        assert found.counts[voxel] == len(kept)
        assert np.array_equal(found.points[voxel, : len(kept)], points[kept])


def test_near_voxels_and_their_maximum_equal_brute_force() -> None:
    """Compiled, in torch, and by loops."""
    generator = torch.Generator().manual_seed(0)
    places = torch.nonzero(torch.rand(2, 4, 9, 8, generator=generator) < 0.2)
    sites, order = Sites.of(places, (4, 9, 8), 2)
    centres = sites.places[:, [3, 2, 1]].float() + 0.5
    points = torch.rand(60, 3, generator=generator) * torch.tensor([12.0, 12.0, 6.0]) - 2
    frames = torch.arange(60)[:, None] % 2
    cells = torch.cat([frames, points.floor().long().flip(1)], dim=1)
    reach, radius, most = (1, 2, 3), 2.2, 4
    found = [
        near_voxels(sites, centres, cells, points, reach, radius, most, compiled=each)
        for each in (True, False)
    ]
    features = torch.randn(len(order), 3, generator=generator, dtype=torch.float64)
    highest = NearMaximum.apply(features.requires_grad_(), found[0])
    for i, (cell, point) in enumerate(zip(cells, points, strict=True)):
        near = [
            j
            for j, place in enumerate(sites.places)
            if place[0] == cell[0]
            and ((place[1:] - cell[1:]).abs() <= torch.tensor(reach)).all()
            and (centres[j] - point).square().sum() <= radius**2
        ][:most]
        expected = near + [near[0]] * (most - len(near)) if near else [-1] * most
        assert found[0][i].tolist() == found[1][i].tolist() == expected
        best = features[near].amax(dim=0) if near else torch.zeros(3, dtype=torch.float64)
        assert torch.equal(highest[i], best)
    assert torch.autograd.gradcheck(lambda rows: NearMaximum.apply(rows, found[0]), (features,))


@pytest.mark.parametrize("name", NAMES)
def test_predictions_repeat_bit_for_bit(name: str) -> None:
    network = random_network(name)
    one, other = (detect(network, sweep(), 0.05, "x") for _ in range(2))
    assert np.array_equal(one.boxes, other.boxes)
    assert np.array_equal(one.scores, other.scores)


def test_the_score_of_both_stages_is_their_geometric_mean(monkeypatch) -> None:
    """The boxes are those of the published rule; only their scores and suppression differ."""
    network = random_network("VoxelRCNN")
    made = make_voxels([sweep()], network.file.data_config)
    head = network.roi_head
    with torch.inference_mode():
        stage = network(Batch.of(made))
        rois, _, first = proposals(network, stage, 0, head.config.nms_config.test)
        second, _ = head(rois, torch.zeros(len(rois), dtype=torch.int64), stage.levels)
    expected = (first.double().sigmoid() * second.double().sigmoid()).sqrt()
    monkeypatch.setattr(head, "config", head.config.model_copy(update={"score": "both"}))
    found = detect(network, sweep(), 0.0, "x").scores
    assert len(found) > 5
    assert_allclose(found[0], expected.max(), atol=1e-6)
    assert (np.abs(found[:, None] - expected.numpy()).min(axis=1) < 1e-6).all()
