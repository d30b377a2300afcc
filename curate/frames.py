"""The sensor data of one frame: a LiDAR sweep, and the images and calibrations of its cameras.

Frames of reference: LiDAR is x forward, y left, z up, in metres; the rectified camera is x right,
y down, z forward, in metres; image coordinates are pixels from the top left corner.
"""

from collections.abc import Sequence
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

    @property
    def has_camera(self) -> bool:
        """Whether there is a camera; see `calibration_without_camera`."""
        return not np.array_equal(self.projection, np.eye(3, 4))

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


def calibration_without_camera() -> Calibration:
    """Return the calibration of data without a camera, for labels in KITTI's form.

    The camera frame is at the LiDAR, with its axes turned: x right, y down, z forward.
    """
    to_camera = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    return Calibration(np.eye(3, 4), to_camera)


@dataclass(frozen=True)
class Camera:
    """One camera of a frame.

    Attributes:
        name: name of the camera, such as CAM_BACK; "" if the data set has only one.
        calibration: see `Calibration`.
        image_size: (width, height) in pixels.
        image: (height, width, 3) uint8 RGB; None if it was not read, or the data set has no images.
    """

    name: str
    calibration: Calibration
    image_size: tuple[int, int]
    image: UInt8[np.ndarray, "height width 3"] | None = None


@dataclass(frozen=True)
class Frame:
    """One LiDAR sweep with the images and calibrations of its cameras: none, one or several.

    The first camera is the reference of labels in KITTI's form. A frame without a camera still has
    a calibration, because such labels are in a camera's frame of reference.

    Attributes:
        frame_id: name of the frame within its data set, e.g. "000008".
        points: (n, 4) float32: x, y, z in metres in the LiDAR frame, and intensity in [0, 1].
        calibration: of the first camera, see `Calibration`.
        image_size: (width, height) of the first camera in pixels; None if there is no camera.
        image: image of the first camera, see `Camera`.
        camera: name of the first camera; "" if the data set has only one.
        further_cameras: the other cameras.
    """

    frame_id: str
    points: Float32[np.ndarray, "n 4"]
    calibration: Calibration
    image_size: tuple[int, int] | None
    image: UInt8[np.ndarray, "height width 3"] | None = None
    camera: str = ""
    further_cameras: tuple[Camera, ...] = ()

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """All cameras of the frame; empty if it has none."""
        if self.image_size is None:
            return ()
        first = Camera(self.camera, self.calibration, self.image_size, self.image)
        return (first, *self.further_cameras)

    def with_points(self, points: Float32[np.ndarray, "n 4"]) -> Self:
        """Return the same frame with other points."""
        return replace(self, points=points)

    def with_cameras(self, cameras: Sequence[Camera]) -> Self:
        """Return the same frame with other cameras, at least one."""
        first, *others = cameras
        return replace(
            self,
            calibration=first.calibration,
            image_size=first.image_size,
            image=first.image,
            camera=first.name,
            further_cameras=tuple(others),
        )

    def views(self) -> tuple[Self, ...]:
        """Return a frame with a single camera for each camera, for code that reads one image."""
        return tuple(self.with_cameras([camera]) for camera in self.cameras)


@dataclass(frozen=True)
class FrameFiles:
    """The paths of a frame's files.

    Attributes:
        points: path of the sweep.
        image: path of the first camera's image; None if the data set has no images.
        calibration: path of the calibration.
        label: path of the label file; None if the frame has none.
        further_images: paths of the images of the other cameras.
    """

    points: Path
    image: Path | None
    calibration: Path
    label: Path | None
    further_images: tuple[Path, ...] = ()

    @property
    def images(self) -> tuple[Path, ...]:
        """The paths of the images of all cameras; empty if the data set has no images."""
        return (*((self.image,) if self.image else ()), *self.further_images)

    def paths(self) -> tuple[Path, ...]:
        """Return all paths of the frame, without the label if there is none."""
        labels = (self.label,) if self.label else ()
        return (self.points, *self.images, self.calibration, *labels)
