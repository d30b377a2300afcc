"""PointPillar, SECOND and Voxel R-CNN: checkpoints of OpenPCDet, or trained by curate."""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from curate.detections import Detections
from curate.detectors.openpcdet.presets import FORMAT_VERSION, PRESETS
from curate.errors import ConfigError, DataError, first_line
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.geometry.ground import GroundMap
from curate.ranges import AtLeastOne, NotNegative, Share
from curate.warnings_once import warn_once

if TYPE_CHECKING:
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

        if not 0 <= lidar_height < 100:
            raise ConfigError(f"detector.options.lidar_height {lidar_height}: give metres")
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
        if abs(below - self._height) > _TOLERANCE_METRES:
            warn_once(
                f"the ground is {below:.1f} m below the LiDAR; the detector expects "
                f"{self._height:g} m: set detector.options.lidar_height = {below:.1f}"
            )


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
