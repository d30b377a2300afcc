"""What the sensors saw: one LiDAR sweep, one image, and the calibration between them.

Frames of reference: LiDAR is x forward, y left, z up, metres; the rectified camera is x right,
y down, z forward, metres; the image is in pixels from the top left corner.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from curate.errors import ConfigError
from curate.shapes import Float, Float32, UInt8


@dataclass(frozen=True)
class Calibration:
    """The transforms between LiDAR, camera and image.

    Attributes:
        projection: (3, 4) rectified camera frame to image pixels (KITTI's P2).
        lidar_to_camera: (4, 4) LiDAR frame to rectified camera frame (KITTI's R0_rect * Tr).
        lidar_to_map: (4, 4) pose of the LiDAR at the time of the sweep in the frame of a map, where
            the data set knows it.
    """

    projection: Float[np.ndarray, "3 4"]
    lidar_to_camera: Float[np.ndarray, "4 4"]
    lidar_to_map: Float[np.ndarray, "4 4"] | None = None

    @property
    def lidar_to_image(self) -> Float[np.ndarray, "3 4"]:
        """(3, 4) LiDAR frame to homogeneous image pixels."""
        return np.asarray(self.projection @ self.lidar_to_camera)

    def pose_in_map(self) -> Float[np.ndarray, "4 4"]:
        """Return (4, 4) LiDAR frame to the frame of the map.

        Raises:
            ConfigError: if the data set has no poses.
        """
        if self.lidar_to_map is None:
            raise ConfigError(
                "boxes in the frame of a map need the vehicle's poses, which this data set does "
                "not have; nuScenes' results belong to a workspace with dataset.kind = 'nuscenes'"
            )
        return self.lidar_to_map


@dataclass(frozen=True)
class Frame:
    """One LiDAR sweep with its image and calibration.

    Attributes:
        frame_id: name of the frame within its data set, e.g. "000008".
        points: (n, 4) float32, x, y, z in metres in the LiDAR frame and intensity in [0, 1].
        calibration: see `Calibration`.
        image_size: (width, height) in pixels.
        image: (height, width, 3) uint8 RGB, or None where the reader was told to leave it out.
    """

    frame_id: str
    points: Float32[np.ndarray, "n 4"]
    calibration: Calibration
    image_size: tuple[int, int]
    image: UInt8[np.ndarray, "height width 3"] | None = None

    def with_points(self, points: Float32[np.ndarray, "n 4"]) -> Self:
        """Return the same frame with other points."""
        return replace(self, points=points)


@dataclass(frozen=True)
class FrameFiles:
    """Where a frame's files lie; `label` is None where the frame has no label file."""

    points: Path
    image: Path
    calibration: Path
    label: Path | None

    def paths(self) -> tuple[Path, ...]:
        """Those that the frame has."""
        return (self.points, self.image, self.calibration, *((self.label,) if self.label else ()))
