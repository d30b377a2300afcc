"""Weighted training labels from the predictions of a 3D detector: what a notebook or script needs.

    from curate import Detections, evaluate_folders, read_labels

Names are loaded when they are first used: `import curate` loads neither torch nor numba.
Boxes are (x, y, z, length, width, height, yaw) in metres and radians, at the box centre in the
LiDAR frame; docs/python-api.md lists every name with its shapes.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from curate.datasets.folder import FolderDataset
    from curate.datasets.kitti.dataset import KittiDataset
    from curate.datasets.kitti.labels import (
        KittiObjects,
        from_detections,
        read_objects,
        to_annotations,
        write_objects,
    )
    from curate.datasets.kitti.raw import KittiRawDataset
    from curate.datasets.nuscenes import NuScenesDataset
    from curate.detections import CATEGORIES, Annotations, Detections
    from curate.detectors.base import Sample
    from curate.detectors.onnx import OnnxDetector
    from curate.detectors.pillars import PillarDetector
    from curate.detectors.recorded import RecordedDetector
    from curate.errors import ConfigError, CurateError, DataError, LeakageError, ModelError
    from curate.evaluation.difficulties import DistanceDifficulty, PointDifficulty
    from curate.evaluation.kitti_ap import KittiEvaluation, evaluate
    from curate.evaluation.kitti_folders import SensorFolders, evaluate_folders, read_folders
    from curate.exporters.data_frames import read_labels
    from curate.frames import Calibration, Camera, Frame
    from curate.geometry.augmented_views import AugmentedViews, augmented_frame
    from curate.geometry.boxes import bev_corners, box_corners
    from curate.geometry.nms import nms_bev
    from curate.geometry.overlap import bev_iou, iou_3d
    from curate.geometry.points_in_boxes import (
        box_of_points,
        count_points_in_boxes,
        points_in_box_mask,
    )
    from curate.geometry.projection import image_rectangles, in_view
    from curate.geometry.similarity import Similarity
    from curate.priors.density import DensityPrior
    from curate.priors.points import PointPrior
    from curate.priors.semantic import SemanticPrior
    from curate.segmenters.instances import InstanceSegmenter
    from curate.segmenters.onnx import OnnxSegmenter
    from curate.segmenters.onnx_instances import OnnxInstanceSegmenter
    from curate.segmenters.saved import SavedSegmenter
    from curate.simulation import simulate
    from curate.training.labels import LabelBatch, WeightedLabels
    from curate.weighting.base import Age, Evidence, Policy, Weights
    from curate.weighting.baseline import Baseline
    from curate.weighting.hssda import HSSDA
    from curate.weighting.iou_match import IoUMatch
    from curate.weighting.self_paced import PSPSL, SPSL
    from curate.weighting.st3d import ST3D
    from curate.weighting.threshold import Threshold
    from curate.weighting.uda_cl import UDACurriculum
    from curate.weighting.uniform import Uniform

__version__ = "0.2.0"

# Static, so that type checkers and editors know the names; a test compares the three lists.
__all__ = [
    "CATEGORIES",
    "HSSDA",
    "PSPSL",
    "SPSL",
    "ST3D",
    "Age",
    "Annotations",
    "AugmentedViews",
    "Baseline",
    "Calibration",
    "Camera",
    "ConfigError",
    "CurateError",
    "DataError",
    "DensityPrior",
    "Detections",
    "DistanceDifficulty",
    "Evidence",
    "FolderDataset",
    "Frame",
    "InstanceSegmenter",
    "IoUMatch",
    "KittiDataset",
    "KittiEvaluation",
    "KittiObjects",
    "KittiRawDataset",
    "LabelBatch",
    "LeakageError",
    "ModelError",
    "NuScenesDataset",
    "OnnxDetector",
    "OnnxInstanceSegmenter",
    "OnnxSegmenter",
    "PillarDetector",
    "PointDifficulty",
    "PointPrior",
    "Policy",
    "RecordedDetector",
    "Sample",
    "SavedSegmenter",
    "SemanticPrior",
    "SensorFolders",
    "Similarity",
    "Threshold",
    "UDACurriculum",
    "Uniform",
    "WeightedLabels",
    "Weights",
    "augmented_frame",
    "bev_corners",
    "bev_iou",
    "box_corners",
    "box_of_points",
    "count_points_in_boxes",
    "evaluate",
    "evaluate_folders",
    "from_detections",
    "image_rectangles",
    "in_view",
    "iou_3d",
    "nms_bev",
    "points_in_box_mask",
    "read_folders",
    "read_labels",
    "read_objects",
    "simulate",
    "to_annotations",
    "write_objects",
]

PUBLIC_MODULES: Final[Mapping[str, Mapping[str, tuple[str, ...]]]] = {
    "Data": {
        "curate.detections": ("CATEGORIES", "Detections", "Annotations"),
        "curate.frames": ("Frame", "Camera", "Calibration"),
        "curate.datasets.kitti.dataset": ("KittiDataset",),
        "curate.datasets.kitti.raw": ("KittiRawDataset",),
        "curate.datasets.folder": ("FolderDataset",),
        "curate.datasets.nuscenes": ("NuScenesDataset",),
        "curate.datasets.kitti.labels": (
            "KittiObjects",
            "read_objects",
            "write_objects",
            "from_detections",
            "to_annotations",
        ),
        "curate.simulation": ("simulate",),
    },
    "Detectors and segmenters": {
        "curate.detectors.recorded": ("RecordedDetector",),
        "curate.detectors.onnx": ("OnnxDetector",),
        "curate.detectors.pillars": ("PillarDetector",),
        "curate.segmenters.onnx": ("OnnxSegmenter",),
        "curate.segmenters.onnx_instances": ("OnnxInstanceSegmenter",),
        "curate.segmenters.saved": ("SavedSegmenter",),
        "curate.segmenters.instances": ("InstanceSegmenter",),
    },
    "Geometry": {
        "curate.geometry.overlap": ("bev_iou", "iou_3d"),
        "curate.geometry.nms": ("nms_bev",),
        "curate.geometry.points_in_boxes": (
            "count_points_in_boxes",
            "box_of_points",
            "points_in_box_mask",
        ),
        "curate.geometry.boxes": ("bev_corners", "box_corners"),
        "curate.geometry.projection": ("in_view", "image_rectangles"),
        "curate.geometry.similarity": ("Similarity",),
        "curate.geometry.augmented_views": ("AugmentedViews", "augmented_frame"),
    },
    "Evidence and weights": {
        "curate.priors.points": ("PointPrior",),
        "curate.priors.semantic": ("SemanticPrior",),
        "curate.priors.density": ("DensityPrior",),
        "curate.weighting.base": ("Evidence", "Age", "Weights", "Policy"),
        "curate.weighting.self_paced": ("PSPSL", "SPSL"),
        "curate.weighting.uniform": ("Uniform",),
        "curate.weighting.uda_cl": ("UDACurriculum",),
        "curate.weighting.iou_match": ("IoUMatch",),
        "curate.weighting.st3d": ("ST3D",),
        "curate.weighting.hssda": ("HSSDA",),
        "curate.weighting.threshold": ("Threshold",),
        "curate.weighting.baseline": ("Baseline",),
    },
    "Exported labels": {
        "curate.exporters.data_frames": ("read_labels",),
        "curate.training.labels": ("WeightedLabels", "LabelBatch"),
        "curate.detectors.base": ("Sample",),
    },
    "Evaluation": {
        "curate.evaluation.kitti_ap": ("evaluate", "KittiEvaluation"),
        "curate.evaluation.kitti_folders": ("evaluate_folders", "read_folders", "SensorFolders"),
        "curate.evaluation.difficulties": ("DistanceDifficulty", "PointDifficulty"),
    },
    "Errors": {
        "curate.errors": (
            "CurateError",
            "ConfigError",
            "DataError",
            "ModelError",
            "LeakageError",
        ),
    },
}
"""The modules behind the public names, by the section of docs/python-api.md that lists them."""

_MODULE_OF: Final = {
    name: module
    for modules in PUBLIC_MODULES.values()
    for module, names in modules.items()
    for name in names
}


if not TYPE_CHECKING:  # type checkers would take every misspelled name for one that is here

    def __getattr__(name: str) -> Any:
        """Load a public name when it is first used (PEP 562)."""
        if name not in _MODULE_OF:
            raise AttributeError(f"module 'curate' has no attribute {name!r}")
        from importlib import import_module

        found = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
        return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
