"""Presets for training from scratch: the public KITTI settings, and reduced networks.

The public ones are those of OpenPCDet's model files for KITTI (`pointpillar.yaml`, `second.yaml`,
`voxel_rcnn_car.yaml`), with the anchors of the data set's categories. The reduced ones have the
same modules on a coarser grid with fewer channels: they train on a CPU.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from curate.detectors.openpcdet.schema import ModelFile, parse_model_file
from curate.errors import ConfigError
from curate.spelling import did_you_mean

FORMAT_VERSION: Final = "1"
"""Version of the entries that curate adds to a checkpoint."""


@dataclass(frozen=True)
class _Anchor:
    """Mean size of a category in metres, z of the anchors' bottom, and KITTI's thresholds."""

    size: tuple[float, float, float]
    bottom: float
    thresholds: tuple[float, float]


_ANCHORS: Final = {
    "Car": _Anchor((3.9, 1.6, 1.56), -1.78, (0.6, 0.45)),
    "Van": _Anchor((5.1, 1.9, 2.2), -1.78, (0.6, 0.45)),
    "Truck": _Anchor((10.1, 2.6, 3.2), -1.78, (0.55, 0.4)),
    "Bus": _Anchor((11.0, 2.9, 3.4), -1.78, (0.55, 0.4)),
    "Tram": _Anchor((16.1, 2.5, 3.5), -1.78, (0.55, 0.4)),
    "Pedestrian": _Anchor((0.8, 0.6, 1.73), -0.6, (0.5, 0.35)),
    "Person_sitting": _Anchor((0.8, 0.6, 1.3), -0.6, (0.5, 0.35)),
    "Cyclist": _Anchor((1.76, 0.6, 1.73), -0.6, (0.5, 0.35)),
    "Motorcycle": _Anchor((2.1, 0.8, 1.5), -0.6, (0.5, 0.3)),
    "Bicycle": _Anchor((1.7, 0.6, 1.3), -0.6, (0.5, 0.35)),
}
# Objects with a smaller footprint are matched more loosely in the reduced networks.
_LARGE_SQUARE_METRES = 4.0
_NMS: Final = {"NMS_TYPE": "nms_gpu", "MULTI_CLASSES_NMS": False}
_CODE_WEIGHTS: Final = [1.0] * 7


@dataclass(frozen=True)
class Preset:
    """The numbers that differ between presets; names follow OpenPCDet's keys.

    Attributes:
        model: name of the architecture.
        limits: lowest x, y, z and highest x, y, z in metres.
        voxel: edges of a voxel along x, y, z in metres.
        channels: of the sparse backbone's input, levels and output; of a pillar.
        layers: convolutions, stride and channels of the levels of the 2D backbone.
        upsampled: stride and channels that each level is upsampled to.
        score: score threshold and NMS threshold, as published.
        small: whether the network is a reduced one.
    """

    model: str
    limits: tuple[float, ...]
    voxel: tuple[float, float, float]
    channels: tuple[int, ...]
    layers: tuple[tuple[int, int, int], ...]
    upsampled: tuple[tuple[int, int], ...]
    score: tuple[float, float]
    small: bool = False


_KITTI: Final = (0, -40, -3, 70.4, 40, 1)
_NEAR: Final = (0, -32, -3, 51.2, 32, 1)
_FINE: Final = (0.05, 0.05, 0.1)
_COARSE: Final = (0.1, 0.1, 0.1)
_FULL: Final = (16, 16, 32, 64, 64, 128)
_NARROW: Final = (8, 8, 16, 32, 32, 32)
PRESETS: Final[dict[str, Preset]] = {
    "voxel-rcnn-small": Preset(
        "VoxelRCNN", _NEAR, _COARSE, _NARROW, ((2, 1, 32), (2, 2, 64)), ((2, 32), (4, 32)),
        (0.1, 0.1), small=True,
    ),
    "second-small": Preset(
        "SECONDNet", _NEAR, _COARSE, _NARROW, ((2, 1, 32), (2, 2, 64)), ((2, 32), (4, 32)),
        (0.1, 0.01), small=True,
    ),
    "pointpillar-small": Preset(
        "PointPillar", (0, -32, -3, 51.2, 32, 1), (0.32, 0.32, 4), (16,),
        ((1, 2, 32), (2, 2, 48), (2, 2, 96)), ((1, 32), (2, 32), (4, 32)), (0.1, 0.01), small=True,
    ),
    "voxel-rcnn": Preset(
        "VoxelRCNN", _KITTI, _FINE, _FULL, ((5, 1, 64), (5, 2, 128)), ((1, 128), (2, 128)),
        (0.3, 0.1),
    ),
    "second": Preset(
        "SECONDNet", _KITTI, _FINE, _FULL, ((5, 1, 128), (5, 2, 256)), ((1, 256), (2, 256)),
        (0.1, 0.01),
    ),
    "pointpillar": Preset(
        "PointPillar", (0, -39.68, -3, 69.12, 39.68, 1), (0.16, 0.16, 4), (64,),
        ((3, 2, 64), (5, 2, 128), (5, 2, 256)), ((1, 128), (2, 128), (4, 128)), (0.1, 0.01),
    ),
}  # fmt: skip


def preset_file(name: str, categories: Sequence[str]) -> ModelFile:
    """Return the model file of a preset for some categories.

    Raises:
        ConfigError: if there is no such preset, or a category has no anchor.
    """
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}; choose one of {', '.join(PRESETS)}")
    unknown = [each for each in categories if each not in _ANCHORS]
    if unknown:
        raise ConfigError(
            f"preset {name}: no anchor for category {unknown[0]!r}"
            f"{did_you_mean(unknown[0], _ANCHORS)}; there are anchors for {', '.join(_ANCHORS)}: "
            "map the name with dataset.rename, or "
            "train with pillars, which has no anchors"
        )
    return parse_model_file(_document(PRESETS[name], categories), f"preset {name}")


def _document(preset: Preset, categories: Sequence[str]) -> dict[str, Any]:
    """Return the content of a preset's model file."""
    pillars = preset.model == "PointPillar"
    stride = (1 if pillars else 8) * preset.layers[0][1] // preset.upsampled[0][0]
    heights = 1 if pillars else 2
    model: dict[str, Any] = {
        "NAME": preset.model,
        "VFE": {"NAME": "PillarVFE", "NUM_FILTERS": list(preset.channels)}
        if pillars
        else {"NAME": "MeanVFE"},
        "MAP_TO_BEV": {
            "NAME": "PointPillarScatter" if pillars else "HeightCompression",
            "NUM_BEV_FEATURES": preset.channels[-1] * heights,
        },
        "BACKBONE_2D": {
            "NAME": "BaseBEVBackbone",
            "LAYER_NUMS": [layers for layers, _, _ in preset.layers],
            "LAYER_STRIDES": [step for _, step, _ in preset.layers],
            "NUM_FILTERS": [width for _, _, width in preset.layers],
            "UPSAMPLE_STRIDES": [step for step, _ in preset.upsampled],
            "NUM_UPSAMPLE_FILTERS": [width for _, width in preset.upsampled],
        },
        "DENSE_HEAD": _anchor_head(preset, categories, stride),
        "POST_PROCESSING": {
            "SCORE_THRESH": preset.score[0],
            "NMS_CONFIG": {
                **_NMS,
                "NMS_THRESH": preset.score[1],
                "NMS_PRE_MAXSIZE": 4096,
                "NMS_POST_MAXSIZE": 500,
            },
        },
    }
    if not pillars:
        model["BACKBONE_3D"] = {"NAME": "VoxelBackBone8x"}
        if preset.channels != _FULL:
            model["BACKBONE_3D"]["CHANNELS"] = list(preset.channels)
    if preset.model == "VoxelRCNN":
        model["ROI_HEAD"] = _roi_head(preset)
    names = ["x", "y", "z", "intensity"]
    return {
        "CLASS_NAMES": list(categories),
        "DATA_CONFIG": {
            "POINT_CLOUD_RANGE": list(preset.limits),
            "POINT_FEATURE_ENCODING": {
                "encoding_type": "absolute_coordinates_encoding",
                "used_feature_list": names,
                "src_feature_list": names,
            },
            "DATA_PROCESSOR": [
                {"NAME": "mask_points_and_boxes_outside_range", "REMOVE_OUTSIDE_BOXES": True},
                {
                    "NAME": "transform_points_to_voxels",
                    "VOXEL_SIZE": list(preset.voxel),
                    "MAX_POINTS_PER_VOXEL": 32 if pillars else 5,
                    "MAX_NUMBER_OF_VOXELS": {"train": 16000, "test": 40000},
                },
            ],
        },
        "MODEL": model,
    }


def _anchor_head(preset: Preset, categories: Sequence[str], stride: int) -> dict[str, Any]:
    """Return the section of the first stage."""
    anchors = []
    for name in categories:
        anchor = _ANCHORS[name]
        matched, unmatched = anchor.thresholds
        if preset.small:  # measured: see docs/detectors.md
            large = anchor.size[0] * anchor.size[1] > _LARGE_SQUARE_METRES
            matched, unmatched = (0.5, 0.35) if large else (0.35, 0.2)
        anchors.append(
            {
                "class_name": name,
                "anchor_sizes": [list(anchor.size)],
                "anchor_rotations": [0, 1.57],
                "anchor_bottom_heights": [anchor.bottom],
                "align_center": False,
                "feature_map_stride": stride,
                "matched_threshold": matched,
                "unmatched_threshold": unmatched,
            }
        )
    weights = {"cls_weight": 1.0, "loc_weight": 2.0, "dir_weight": 0.2}
    return {
        "NAME": "AnchorHeadSingle",
        "CLASS_AGNOSTIC": False,
        "USE_DIRECTION_CLASSIFIER": True,
        "DIR_OFFSET": 0.78539,
        "DIR_LIMIT_OFFSET": 0.0,
        "NUM_DIR_BINS": 2,
        "ANCHOR_GENERATOR_CONFIG": anchors,
        "TARGET_ASSIGNER_CONFIG": {
            "NAME": "AxisAlignedTargetAssigner",
            "BOX_CODER": "ResidualCoder",
        },
        "LOSS_CONFIG": {"LOSS_WEIGHTS": {**weights, "code_weights": _CODE_WEIGHTS}},
    }


def _roi_head(preset: Preset) -> dict[str, Any]:
    """Return the section of the second stage."""
    width, samples, grid, shared = (16, 8, 4, 64) if preset.small else (32, 16, 6, 256)
    cell = preset.voxel[0]
    levels = {
        f"x_conv{level}": {
            "MLPS": [[width, width]],
            "QUERY_RANGES": [[4, 4, 4]],
            "POOL_RADIUS": [cell * 2 ** (level + 1)],
            "NSAMPLE": [samples],
            "POOL_METHOD": "max_pool",
        }
        for level in (2, 3, 4)
    }
    most, kept, sampled = (2048, 128, 32) if preset.small else (9000, 512, 128)
    weights = {f"rcnn_{name}_weight": 1.0 for name in ("cls", "reg", "corner", "iou3d")}
    return {
        "NAME": "VoxelRCNNHead",
        "CLASS_AGNOSTIC": True,
        "SHARED_FC": [shared, shared],
        "CLS_FC": [shared, shared],
        "REG_FC": [shared, shared],
        "DP_RATIO": 0.3,
        "SCORE": "both" if preset.small else "roi",
        "NMS_CONFIG": {
            "TRAIN": {
                **_NMS, "NMS_PRE_MAXSIZE": most, "NMS_POST_MAXSIZE": kept, "NMS_THRESH": 0.8
            },
            "TEST": {
                **_NMS, "NMS_PRE_MAXSIZE": 2048, "NMS_POST_MAXSIZE": 100, "NMS_THRESH": 0.7,
                "USE_FAST_NMS": False, "SCORE_THRESH": 0.0,
            },
        },
        "ROI_GRID_POOL": {
            "FEATURES_SOURCE": list(levels),
            "PRE_MLP": True,
            "GRID_SIZE": grid,
            "POOL_LAYERS": levels,
        },
        "TARGET_CONFIG": {
            "BOX_CODER": "ResidualCoder",
            "ROI_PER_IMAGE": sampled,
            "FG_RATIO": 0.5,
            "SAMPLE_ROI_BY_EACH_CLASS": True,
            "CLS_SCORE_TYPE": "roi_iou",
            "CLS_FG_THRESH": 0.75,
            "CLS_BG_THRESH": 0.25,
            "CLS_BG_THRESH_LO": 0.1,
            "HARD_BG_RATIO": 0.8,
            "REG_FG_THRESH": 0.55,
        },
        "LOSS_CONFIG": {
            "CLS_LOSS": "BinaryCrossEntropy",
            "REG_LOSS": "smooth-l1",
            "CORNER_LOSS_REGULARIZATION": True,
            "GRID_3D_IOU_LOSS": False,
            "LOSS_WEIGHTS": {**weights, "code_weights": _CODE_WEIGHTS},
        },
    }  # fmt: skip
