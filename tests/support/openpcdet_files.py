"""Small model files of OpenPCDet, with checkpoints of random weights."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from curate.detections import CATEGORIES
from curate.detectors.openpcdet.network import DetectionNetwork
from curate.detectors.openpcdet.schema import ModelFile, parse_model_file

_SIZES = {"Car": (3.9, 1.6, 1.56), "Pedestrian": (0.8, 0.6, 1.73), "Cyclist": (1.76, 0.6, 1.73)}
_NMS = {"NMS_TYPE": "nms_gpu", "MULTI_CLASSES_NMS": False}
_CODE = [1.0] * 7


def document(name: str = "VoxelRCNN", classes: tuple[str, ...] = CATEGORIES) -> dict[str, Any]:
    """Return the content of a small model file for an architecture by OpenPCDet's name."""
    pillars, height = name == "PointPillar", 4.0 if name == "PointPillar" else 0.1
    stride = 2 if pillars else 8
    model: dict[str, Any] = {
        "NAME": name,
        "VFE": {"NAME": "MeanVFE"},
        "BACKBONE_3D": {"NAME": "VoxelBackBone8x", "CHANNELS": [4, 4, 8, 8, 8, 8]},
        "MAP_TO_BEV": {"NAME": "HeightCompression", "NUM_BEV_FEATURES": 16},
        "BACKBONE_2D": {
            "NAME": "BaseBEVBackbone",
            "LAYER_NUMS": [1, 1],
            "LAYER_STRIDES": [stride if pillars else 1, 2],
            "NUM_FILTERS": [8, 8],
            "UPSAMPLE_STRIDES": [1, 2],
            "NUM_UPSAMPLE_FILTERS": [8, 8],
        },
        "DENSE_HEAD": {
            "NAME": "AnchorHeadSingle",
            "CLASS_AGNOSTIC": False,
            "USE_DIRECTION_CLASSIFIER": True,
            "DIR_OFFSET": 0.78539,
            "DIR_LIMIT_OFFSET": 0.0,
            "NUM_DIR_BINS": 2,
            "ANCHOR_GENERATOR_CONFIG": [
                {
                    "class_name": each,
                    "anchor_sizes": [_SIZES[each]],
                    "anchor_rotations": [0, 1.57],
                    "anchor_bottom_heights": [-1.78],
                    "align_center": False,
                    "feature_map_stride": stride,
                    "matched_threshold": 0.5,
                    "unmatched_threshold": 0.35,
                }
                for each in classes
            ],
            "TARGET_ASSIGNER_CONFIG": {
                "NAME": "AxisAlignedTargetAssigner", "POS_FRACTION": -1.0, "SAMPLE_SIZE": 512,
                "NORM_BY_NUM_EXAMPLES": False, "MATCH_HEIGHT": False, "BOX_CODER": "ResidualCoder",
            },
            "LOSS_CONFIG": {
                "LOSS_WEIGHTS": {
                    "cls_weight": 1.0, "loc_weight": 2.0, "dir_weight": 0.2, "code_weights": _CODE,
                },
            },
        },
        "POST_PROCESSING": {
            "SCORE_THRESH": 0.1,
            "NMS_CONFIG": {**_NMS, "NMS_THRESH": 0.1, "NMS_PRE_MAXSIZE": 4096,
                           "NMS_POST_MAXSIZE": 500},
        },
    }  # fmt: skip
    if pillars:
        model["VFE"] = {
            "NAME": "PillarVFE", "WITH_DISTANCE": False, "USE_ABSLOTE_XYZ": True, "USE_NORM": True,
            "NUM_FILTERS": [8],
        }  # fmt: skip
        model["MAP_TO_BEV"] = {"NAME": "PointPillarScatter", "NUM_BEV_FEATURES": 8}
        del model["BACKBONE_3D"]
    if name == "VoxelRCNN":
        model["ROI_HEAD"] = _roi_head()
    return {
        "CLASS_NAMES": list(classes),
        "DATA_CONFIG": {
            "POINT_CLOUD_RANGE": [0, -25.6, -3, 51.2, 25.6, 1],
            "POINT_FEATURE_ENCODING": {
                "encoding_type": "absolute_coordinates_encoding",
                "used_feature_list": ["x", "y", "z", "intensity"],
                "src_feature_list": ["x", "y", "z", "intensity"],
            },
            "DATA_PROCESSOR": [
                {"NAME": "mask_points_and_boxes_outside_range", "REMOVE_OUTSIDE_BOXES": True},
                {
                    "NAME": "transform_points_to_voxels",
                    "VOXEL_SIZE": [0.32, 0.32, 4.0] if pillars else [0.2, 0.2, height],
                    "MAX_POINTS_PER_VOXEL": 5,
                    "MAX_NUMBER_OF_VOXELS": {"train": 16000, "test": 40000},
                },
            ],
        },
        "MODEL": model,
    }


def _roi_head() -> dict[str, Any]:
    level = {"MLPS": [[4, 4]], "QUERY_RANGES": [[4, 4, 4]], "NSAMPLE": [8],
             "POOL_METHOD": "max_pool"}  # fmt: skip
    return {
        "NAME": "VoxelRCNNHead",
        "CLASS_AGNOSTIC": True,
        "SHARED_FC": [8, 8],
        "CLS_FC": [8, 8],
        "REG_FC": [8, 8],
        "DP_RATIO": 0.3,
        "NMS_CONFIG": {
            "TRAIN": {**_NMS, "NMS_PRE_MAXSIZE": 2000, "NMS_POST_MAXSIZE": 64, "NMS_THRESH": 0.8},
            "TEST": {**_NMS, "NMS_PRE_MAXSIZE": 1024, "NMS_POST_MAXSIZE": 40, "NMS_THRESH": 0.7},
        },
        "ROI_GRID_POOL": {
            "FEATURES_SOURCE": ["x_conv2", "x_conv3"],
            "PRE_MLP": True,
            "GRID_SIZE": 3,
            "POOL_LAYERS": {
                "x_conv2": {**level, "POOL_RADIUS": [0.8]},
                "x_conv3": {**level, "POOL_RADIUS": [1.6]},
            },
        },
        "TARGET_CONFIG": {
            "BOX_CODER": "ResidualCoder", "ROI_PER_IMAGE": 16, "FG_RATIO": 0.5,
            "SAMPLE_ROI_BY_EACH_CLASS": True, "CLS_SCORE_TYPE": "roi_iou", "CLS_FG_THRESH": 0.75,
            "CLS_BG_THRESH": 0.25, "CLS_BG_THRESH_LO": 0.1, "HARD_BG_RATIO": 0.8,
            "REG_FG_THRESH": 0.55,
        },
        "LOSS_CONFIG": {
            "CLS_LOSS": "BinaryCrossEntropy", "REG_LOSS": "smooth-l1",
            "CORNER_LOSS_REGULARIZATION": True, "GRID_3D_IOU_LOSS": False,
            "LOSS_WEIGHTS": {
                "rcnn_cls_weight": 1.0, "rcnn_reg_weight": 1.0, "rcnn_corner_weight": 1.0,
                "rcnn_iou3d_weight": 1.0, "code_weights": _CODE,
            },
        },
    }  # fmt: skip


def model_file(name: str = "VoxelRCNN") -> ModelFile:
    """Return a small model file."""
    return parse_model_file(document(name), "test.yaml")


def random_network(name: str = "VoxelRCNN", seed: int = 0) -> DetectionNetwork:
    """Return a network with random weights whose scores spread over (0, 1)."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = DetectionNetwork(model_file(name))
        for key, tensor in network.named_parameters():
            if tensor.dim() > 1:
                scale = 0.05 if "conv_box" in key or "reg_pred" in key else 1.4
                torch.nn.init.normal_(tensor, std=scale / (tensor[0].numel()) ** 0.5)
        torch.nn.init.zeros_(network.dense_head.conv_cls.bias)
    return network.eval()


def write_files(folder: Path, name: str = "VoxelRCNN", seed: int = 0) -> Path:
    """Write a checkpoint in OpenPCDet's form and its model file; return the checkpoint's path."""
    network = random_network(name, seed)
    path = folder / "model.pth"
    save_state(path, {**network.state_dict(), "global_step": torch.zeros(1, dtype=torch.int64)})
    path.with_suffix(".yaml").write_text(json.dumps(document(name)))
    return path


def save_state(path: Path, state: Mapping[str, Any]) -> None:
    """Write a state as OpenPCDet does."""
    content = {"epoch": 1, "it": 1, "model_state": dict(state), "optimizer_state": None}
    torch.save({**content, "version": "pcdet+0.6.0"}, path)


def sweep(count: int = 3000, seed: int = 0) -> np.ndarray:
    """Return (n, 4) float32 points on a flat ground with a few objects."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(1, 50, count), rng.uniform(-25, 25, count),
                              np.full(count, -1.7)])  # fmt: skip
    centres = rng.uniform((5, -20, -1), (45, 20, -0.6), (8, 3))
    objects = centres[rng.integers(8, size=count)] + rng.normal(0, (1, 0.5, 0.4), (count, 3))
    points = np.concatenate([ground, objects])
    return np.column_stack([points, rng.random(len(points))]).astype(np.float32)
