"""PointPillar, SECOND and Voxel R-CNN: checkpoints of OpenPCDet, or trained by curate."""

import shlex
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from curate.detections import CATEGORIES, Detections
from curate.detectors.openpcdet.presets import FORMAT_VERSION, PRESETS
from curate.errors import ConfigError, DataError, first_line
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.geometry.ground import GroundMap
from curate.ranges import AtLeastOne, NotNegative, Share
from curate.warnings_once import warn_once

if TYPE_CHECKING:
    from curate.detectors.openpcdet.schema import ModelFile
    from curate.detectors.openpcdet.training import AnchorStudent

# Height of KITTI's LiDAR above the ground in metres. The anchors of the public models fit it.
MODEL_HEIGHT = 1.73
# The height of the ground is checked in this number of frames, near the vehicle.
_CHECKED_FRAMES = 5
_NEAR_METRES = 25.0
_TOLERANCE_METRES = 0.5


class OpenPCDetDetector:
    """A `Detector` that runs a checkpoint of OpenPCDet in plain torch.

    Args:
        checkpoint: the .pth file.
        config: its model file (YAML); by default the one in the checkpoint or beside it.
        device: "cpu", or a torch device such as "cuda".
        minimum_score: boxes with a lower score are left out, whatever the model file says.
        threads: number of threads of torch, on CPU.
        lidar_height: height of the LiDAR above the ground in metres. Points are shifted to the
            height that the model was made for, 1.73 m, and boxes back.

    Raises:
        ModelError: if the checkpoint is missing or damaged, contains code, or does not belong to
            the model file.
        ConfigError: if there is no model file, it has a module or key that curate does not
            support, or the device cannot be used.
    """

    presets: ClassVar[Collection[str]] = PRESETS.keys()
    checkpoint_suffix: ClassVar[str] = ".pth"
    checkpoint_version: ClassVar[str] = FORMAT_VERSION

    def __init__(
        self,
        checkpoint: StrPath,
        *,
        config: StrPath | None = None,
        device: str = "cpu",
        minimum_score: Share = 0.1,
        threads: AtLeastOne = 1,
        lidar_height: NotNegative = MODEL_HEIGHT,
    ) -> None:
        import torch

        from curate.detectors.openpcdet.checkpoint import load_network

        _checked_height(lidar_height)
        network, _ = load_network(Path(checkpoint), None if config is None else Path(config))
        try:
            self._network = network.to(torch.device(device))
        except (RuntimeError, AssertionError) as error:
            raise ConfigError(f"device {device!r} cannot be used: {first_line(error)}") from None
        if device == "cpu":
            torch.set_num_threads(threads)
        self._minimum_score = minimum_score
        self._raise_by = MODEL_HEIGHT - lidar_height
        self._height = lidar_height
        self._frames = 0

    @classmethod
    def check_checkpoint(cls, checkpoint: Path) -> None:
        """See `curate.detectors.base.TrainableDetector`.

        A checkpoint of OpenPCDet is compared with its model file when it is loaded.
        """
        from curate.detectors.openpcdet.checkpoint import load_checkpoint, load_network

        if load_checkpoint(checkpoint).preset is not None:
            load_network(checkpoint)

    @classmethod
    def new_student(cls, preset: str, categories: tuple[str, ...]) -> "AnchorStudent":
        """See `curate.detectors.base.TrainableDetector`."""
        from curate.detectors.openpcdet.training import AnchorStudent

        return AnchorStudent.new(preset, categories)

    @classmethod
    def load_student(cls, checkpoint: Path, *, config: StrPath | None = None) -> "AnchorStudent":
        """See `curate.detectors.base.TrainableDetector`; `config` as in the constructor."""
        from curate.detectors.openpcdet.training import AnchorStudent

        return AnchorStudent.load(checkpoint, None if config is None else Path(config))

    @classmethod
    def score_meaning(
        cls, preset: str, checkpoint: Path | None = None, options: Mapping[str, Any] | None = None
    ) -> str:
        """See `curate.detectors.base.DescribesScores`; Voxel R-CNN learns the overlap of a box."""
        from curate.detectors.openpcdet.presets import preset_file
        from curate.detectors.openpcdet.schema import load_model_file

        config = (options or {}).get("config")
        file: ModelFile | None
        if checkpoint is None:
            file = preset_file(preset, CATEGORIES)
        elif config is not None:
            file = load_model_file(Path(config))
        else:
            from curate.detectors.openpcdet.checkpoint import load_checkpoint

            file = load_checkpoint(checkpoint).file
        if file is None or file.model.roi_head is None:
            return "the probability of the category"
        learned = file.model.roi_head.target_config
        low, high = learned.cls_bg_thresh, learned.cls_fg_thresh
        overlap = (
            f"the 3D IoU of the box with the object (0 up to an IoU of {low:g}, 1 from {high:g})"
        )
        if file.model.roi_head.score == "both":
            return f"the geometric mean of the probability of the category and of {overlap}"
        return overlap

    @classmethod
    def export_onnx(
        cls, checkpoint: Path, output: Path, options: Mapping[str, Any]
    ) -> tuple[str, ...]:
        """See `curate.detectors.base.ExportsOnnx`."""
        from curate.detectors.openpcdet.checkpoint import load_network
        from curate.detectors.openpcdet.onnx_graph import build_graph
        from curate.files.onnx_graph import write_model
        from curate.files.toml_text import toml

        config = options.get("config")
        network, _ = load_network(checkpoint, None if config is None else Path(config))
        height = _checked_height(options.get("lidar_height", MODEL_HEIGHT))
        write_model(build_graph(network, height - MODEL_HEIGHT), output)
        own = {
            "classes": list(network.file.class_names),
            "nms_iou": network.file.model.post_processing.nms_config.nms_thresh,
            "nms_across": True,
        }
        setting = f"detector.options={toml(own)}"
        path = shlex.quote(str(output.resolve()))
        return (
            "in: points [n, 4] float32, x, y, z, intensity in [0, 1] in the LiDAR frame",
            "out: boxes [k, 7], scores [k] and labels [k], before suppression",
            f"in curate: --detector onnx --detector-path {path} --set {shlex.quote(setting)}",
        )

    @property
    def categories(self) -> tuple[str, ...]:
        """The class names of the model file."""
        return self._network.file.class_names

    def category_names(self) -> tuple[str, ...]:
        """See `curate.detectors.base.NamesCategories`."""
        return self.categories

    def predict(self, frame: Frame) -> Detections:
        """See `curate.detectors.base.Detector`; a sweep without points has no boxes.

        Raises:
            DataError: if an intensity is not in [0, 1].
        """
        from curate.detectors.openpcdet.inference import detect

        if len(frame.points) == 0:
            return Detections.empty()
        _check_intensities(frame)
        self._check_ground(frame.points)
        points = frame.points
        if self._raise_by:
            points = points - np.array([0, 0, self._raise_by, 0], dtype=np.float32)
        found = detect(self._network, points, self._minimum_score, frame.frame_id)
        if self._raise_by:
            found = replace(found, boxes=found.boxes + np.array([0, 0, self._raise_by, 0, 0, 0, 0]))
        return found

    def _check_ground(self, points: np.ndarray) -> None:
        """Warn if the ground is not where the model expects it, in the first frames."""
        if self._frames >= _CHECKED_FRAMES:
            return
        self._frames += 1
        heights = GroundMap.of(points[(np.abs(points[:, :2]) < _NEAR_METRES).all(axis=1)]).heights
        if np.isnan(heights).all():
            return
        below = -float(np.nanmedian(heights))
        if abs(below - self._height) <= _TOLERANCE_METRES:
            return
        self._frames = _CHECKED_FRAMES
        if below < -_TOLERANCE_METRES:
            warn_once(f"the ground is {-below:.1f} m above the origin of the points: is z up?")
        else:
            warn_once(
                f"the ground is {max(below, 0):.1f} m below the LiDAR; the detector expects "
                f"{self._height:g} m: set detector.options.lidar_height = {max(below, 0):.1f}"
            )


def _checked_height(metres: object) -> float:
    """Return the height of the LiDAR, or raise ConfigError."""
    if isinstance(metres, int | float) and 0 <= metres < 100:
        return float(metres)
    raise ConfigError(f"detector.options.lidar_height {metres!r}: expected metres, 0 to 100")


def _check_intensities(frame: Frame) -> None:
    """Raise DataError if an intensity is not in [0, 1]: the network would compute with it."""
    intensities = frame.points[:, 3]
    low, high = float(intensities.min()), float(intensities.max())
    if np.isnan(low) or np.isnan(high):
        raise DataError(f"frame {frame.frame_id}: points without a finite intensity (NaN)")
    if low < 0 or high > 1:
        raise DataError(
            f"frame {frame.frame_id}: intensities from {low:g} to {high:g}, the detector needs "
            "[0, 1]; set dataset.intensity_scale to the value of full intensity"
        )
