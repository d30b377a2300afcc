"""The sensor data of one frame: a LiDAR sweep, an image, and the calibration between them.

Frames of reference: LiDAR is x forward, y left, z up, in metres; the rectified camera is x right,
y down, z forward, in metres; image coordinates are pixels from the top left corner.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self

import numpy as np

from curate.errors import ConfigError
from curate.shapes import Float, Float32, UInt8

RotationY = Literal[
    "calibration", "openpcdet", "mmdetection3d", "view-of-delft", "nuscenes", "dair-v2x"
]
"""The meaning of rotation_y in files of KITTI's form, named by who writes it.

"calibration": an angle about the LiDAR's vertical from the direction in which the camera looks.
"openpcdet", "mmdetection3d", "view-of-delft": -yaw - pi/2, whatever the mounting of the camera is.
"nuscenes" (its export to KITTI), "dair-v2x": the heading projected into the camera's xz plane.
All agree for a camera that looks along x and is level. See `curate.geometry.mounting`."""


@dataclass(frozen=True)
class Calibration:
    """The transforms between LiDAR, camera and image.

    Attributes:
        projection: (3, 4) rectified camera frame to image pixels (KITTI's P2).
        lidar_to_camera: (4, 4) LiDAR frame to rectified camera frame (KITTI's R0_rect * Tr).
        lidar_to_map: (4, 4) pose of the LiDAR in the map frame at the time of the sweep; None if
            the data set has no poses.
        rotation_y: the meaning of rotation_y in the data set's label files.
    """

    projection: Float[np.ndarray, "3 4"]
    lidar_to_camera: Float[np.ndarray, "4 4"]
    lidar_to_map: Float[np.ndarray, "4 4"] | None = None
    rotation_y: RotationY = "calibration"

    @property
    def lidar_to_image(self) -> Float[np.ndarray, "3 4"]:
        """The (3, 4) projection from the LiDAR frame to homogeneous image pixels."""
        return np.asarray(self.projection @ self.lidar_to_camera)

    def pose_in_map(self) -> Float[np.ndarray, "4 4"]:
        """Return the (4, 4) transform from the LiDAR frame to the map frame.

        Raises:
            ConfigError: if the data set has no poses.
        """
        if self.lidar_to_map is None:
            raise ConfigError(
                "boxes in the map frame need the vehicle's poses, and this data set has none; "
                "use nuScenes results in a workspace with dataset.kind = 'nuscenes'"
            )
        return self.lidar_to_map


@dataclass(frozen=True)
class Frame:
    """One LiDAR sweep with its image and calibration.

    Attributes:
        frame_id: name of the frame within its data set, e.g. "000008".
        points: (n, 4) float32: x, y, z in metres in the LiDAR frame, and intensity in [0, 1].
        calibration: see `Calibration`.
        image_size: (width, height) in pixels.
        image: (height, width, 3) uint8 RGB; None if it was not read.
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
    """The paths of a frame's files; `label` is None if the frame has no label file."""

    points: Path
    image: Path
    calibration: Path
    label: Path | None

    def paths(self) -> tuple[Path, ...]:
        """Return all paths of the frame, without the label if there is none."""
        return (self.points, self.image, self.calibration, *((self.label,) if self.label else ()))
