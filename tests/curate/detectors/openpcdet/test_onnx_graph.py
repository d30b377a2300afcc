"""PointPillar as an ONNX model: the boxes of the network in torch, from the same points."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from contracts.samples import assert_one_line
from numpy.testing import assert_allclose
from scipy.spatial import KDTree
from support.openpcdet_files import document, save_state, sweep, write_files

from curate.detections import Detections
from curate.detectors.onnx import OnnxDetector
from curate.detectors.openpcdet import OpenPCDetDetector
from curate.detectors.openpcdet.checkpoint import load_network, save_checkpoint
from curate.detectors.openpcdet.network import Batch, DetectionNetwork
from curate.detectors.openpcdet.onnx_graph import build_graph
from curate.detectors.openpcdet.schema import parse_model_file
from curate.detectors.openpcdet.voxels import make_voxels
from curate.errors import ConfigError
from curate.files.toml_text import parse_toml
from curate.frames import Frame, calibration_without_camera
from curate.geometry.similarity import wrap_angle


def frame_of(points: np.ndarray) -> Frame:
    """Return a frame without a camera."""
    return Frame("000000", points, calibration_without_camera(), None)


def exported(checkpoint: Path, **options: Any) -> OnnxDetector:
    """Return the detector of the exported model, with the options that the export prints."""
    output = checkpoint.with_suffix(".onnx")
    *_, usage = OpenPCDetDetector.export_onnx(checkpoint, output, options)
    assert f"--detector-path {output} --set 'detector.options={{" in usage
    return OnnxDetector(output, **parse_toml(usage.split("'")[1].replace(".", "_", 1))[
        "detector_options"
    ])  # fmt: skip


def assert_same(found: Detections, expected: Detections) -> None:
    """Compare boxes in any order: scores may be equal."""
    assert len(found) == len(expected) > 0
    assert_allclose(found.scores, expected.scores, rtol=0, atol=1e-5)
    away = found.boxes[:, None] - expected.boxes
    away[..., 6] = wrap_angle(away[..., 6])
    away = np.abs(away).max(axis=2) + 9 * (found.categories[:, None] != expected.categories)
    assert away.min(axis=0).max() < 1e-3
    assert away.min(axis=1).max() < 1e-3


def write(folder: Path, content: Mapping[str, Any]) -> Path:
    """Write a checkpoint for a model file: random weights with scores all over (0, 1)."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = DetectionNetwork(parse_model_file(content, "test"))
        for key, each in network.named_parameters():
            if each.dim() > 1:
                scale = 0.05 if "conv_box" in key else 1.4
                torch.nn.init.normal_(each, std=scale / each[0].numel() ** 0.5)
            elif "norm" in key:
                torch.nn.init.uniform_(each, -1, 1)
        torch.nn.init.zeros_(network.dense_head.conv_cls.bias)
    path = folder / "model.pth"
    save_state(path, network.state_dict())
    path.with_suffix(".yaml").write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("vfe", "places"),
    [
        ({}, 5),
        ({"WITH_DISTANCE": True}, 17),
        ({"USE_ABSLOTE_XYZ": False, "NUM_FILTERS": [12, 8]}, 5),
    ],
)
def test_the_exported_model_computes_the_same_for_every_anchor(
    tmp_path: Path, vfe: dict, places: int
) -> None:
    """Full and other pillars, more pillars than the cap, and every form of the point features."""
    content = document("PointPillar")
    content["MODEL"]["VFE"] |= vfe
    content["MODEL"]["DENSE_HEAD"]["DIR_LIMIT_OFFSET"] = 0.5
    content["MODEL"]["POST_PROCESSING"]["NMS_CONFIG"]["NMS_PRE_MAXSIZE"] = 10**6
    caps = {"MAX_NUMBER_OF_VOXELS": {"train": 9, "test": 1500}, "MAX_POINTS_PER_VOXEL": places}
    content["DATA_CONFIG"]["DATA_PROCESSOR"][1] |= caps
    network, _ = load_network(write(tmp_path, content))
    points = np.concatenate([sweep(), sweep(seed=1)])
    points[:2, :3] = [[0, -25.6, -3], [51.2, 25.6, 1]]  # both ends of the range
    voxels = make_voxels([points], network.file.data_config)
    assert voxels.left_out[0] > 0
    assert voxels.counts.max() == places > voxels.counts.min()
    with torch.inference_mode():
        stage = network(Batch.of(voxels))
        logits, labels = stage.class_logits[0].max(dim=1)
        boxes = network.boxes_of(stage, 0, torch.arange(len(logits)))
    scores = torch.sigmoid(logits)
    assert scores.std() > 0.01
    session = onnxruntime.InferenceSession(build_graph(network).SerializeToString())
    found = session.run(["boxes", "scores", "labels"], {"points": points})
    assert_allclose(found[1], scores.sort(descending=True)[0], rtol=0, atol=1e-5)
    expected = KDTree(np.column_stack([boxes, scores, 10 * labels]))
    away, _ = expected.query(np.column_stack([found[0], found[1], 10 * found[2]]))
    assert away.max() < 1e-3
    points[:, 0] += 1000  # outside the range: the network in torch is not run at all
    assert session.run(["scores"], {"points": points})[0].max() == 0


def test_the_exported_model_is_used_as_the_export_says(tmp_path: Path) -> None:
    """Without direction classifier, for a higher LiDAR, from a checkpoint with its model file."""
    content = document("PointPillar")
    for key in ("USE_DIRECTION_CLASSIFIER", "DIR_OFFSET"):
        del content["MODEL"]["DENSE_HEAD"][key]
    path, points = write(tmp_path, content), sweep() - np.array([0, 0, 1, 0], np.float32)
    network, _ = load_network(path)
    path.with_suffix(".yaml").unlink()
    save_checkpoint(path, network, network.state_dict(), "pointpillar-small")
    expected = OpenPCDetDetector(path, lidar_height=2.73).predict(frame_of(points))
    found = exported(path, lidar_height=2.73).predict(frame_of(points))
    assert_same(found.select(np.arange(20)), expected.select(np.arange(20)))


def test_the_boxes_of_openpcdet_on_a_real_sweep(
    openpcdet_oracle: Path, kitti_root: Path, tmp_path: Path
) -> None:
    """Its own numbers, at its score threshold."""
    for suffix in (".pth", ".yaml"):
        content = (openpcdet_oracle / f"pointpillar{suffix}").read_bytes()
        (tmp_path / f"pointpillar{suffix}").write_bytes(content)
    numbers = np.load(openpcdet_oracle / "pointpillar_eval_000008.npz")
    path = kitti_root / "training/velodyne/000008.bin"
    points = np.fromfile(path, dtype=np.float32).reshape(-1, 4)
    points = points[np.unpackbits(numbers["point_mask_packed"])[: len(points)].astype(bool)]
    found = exported(tmp_path / "pointpillar.pth").predict(frame_of(points))
    found = found.select(found.scores >= numbers["final_scores"].min() - 1e-6)
    names = np.array(["Car", "Pedestrian", "Cyclist"])[numbers["final_labels"] - 1]
    expected = Detections(numbers["final_boxes"], numbers["final_scores"], names)
    assert_same(found, expected.select(np.argsort(-expected.scores)))


@pytest.mark.parametrize("name", ["SECONDNet", "VoxelRCNN"])
def test_sparse_networks_cannot_be_exported(tmp_path: Path, name: str) -> None:
    output = tmp_path / "model.onnx"
    with pytest.raises(ConfigError, match=f"{name} cannot be exported: ONNX has no sp") as caught:
        OpenPCDetDetector.export_onnx(write_files(tmp_path, name), output, {})
    assert_one_line(caught.value)
    assert not output.exists()
