"""How the camera is mounted: calibration in KITTI's form, a little different in every scene."""

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np

from curate.frames import Calibration
from curate.simulation.shading import pixel_rays

IMAGE_SIZE = (1242, 375)
"""Width and height in pixels."""

# Typical of KITTI's recordings: the camera looks along the LiDAR's x axis, 27 cm before it and
# 8 cm below; the rotation that remains is below one degree.
_AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
_LEVER_M = np.array([-0.004, -0.076, -0.272])
_TYPICAL_TURN_RAD = np.array([0.0148, -0.0075, 0.0007])
_RECTIFICATION_RAD = np.array([-0.0043, -0.0074, -0.0098])


@dataclass(frozen=True)
class CameraRig:
    """The left colour camera.

    Attributes:
        projection: (3, 4) KITTI's P2.
        rectification: (3, 3) KITTI's R0_rect.
        extrinsic: (3, 4) KITTI's Tr_velo_to_cam.
    """

    projection: np.ndarray
    rectification: np.ndarray
    extrinsic: np.ndarray

    @classmethod
    def draw(cls, generator: np.random.Generator) -> Self:
        """Return a random rig near KITTI's."""
        focal = generator.uniform(707, 722)
        centre = np.array([609.0, 175.0]) + generator.normal(0, (3, 2.5))
        projection = np.array(
            [
                [focal, 0, centre[0], generator.normal(45, 0.5)],
                [0, focal, centre[1], generator.normal(0.2, 0.1)],
                [0, 0, 1, 0.0027],
            ]
        )
        turn = _TYPICAL_TURN_RAD + generator.normal(0, 0.003, size=3)
        rectify = _RECTIFICATION_RAD + generator.normal(0, 0.0015, size=3)
        lever = _LEVER_M + generator.normal(0, 0.01, size=3)
        extrinsic = np.column_stack([_rotation(turn) @ _AXES, lever])
        return cls(projection, _rotation(rectify), extrinsic)

    @property
    def calibration(self) -> Calibration:
        """The same as the readers hand it out."""
        lidar_to_camera = np.eye(4)
        lidar_to_camera[:3] = self.rectification @ self.extrinsic
        return Calibration(self.projection, lidar_to_camera)

    def kitti_text(self) -> str:
        """Return the content of KITTI's calibration file; the other cameras repeat this one."""
        matrices = dict.fromkeys(("P0", "P1", "P2", "P3"), self.projection)
        matrices["R0_rect"] = self.rectification
        matrices["Tr_velo_to_cam"] = self.extrinsic
        matrices["Tr_imu_to_velo"] = np.eye(4)[:3]
        return "".join(
            f"{key}: {' '.join(f'{number:.12e}' for number in matrix.ravel())}\n"
            for key, matrix in matrices.items()
        )

    def pixel_geometry(self) -> tuple[np.ndarray, np.ndarray]:
        """(3, 3) from homogeneous pixels to directions, (3,) the camera's centre; LiDAR frame."""
        matrix = self.calibration.lidar_to_image
        inverse = np.linalg.inv(matrix[:, :3])
        return inverse, -inverse @ matrix[:, 3]

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Rays through pixel centres, LiDAR frame.

        Args:
            pixels: (n,) row * width + column.

        Returns:
            (n, 6) float32 origin and unit direction.
        """
        return np.asarray(pixel_rays(*self.pixel_geometry(), pixels, IMAGE_SIZE[0]))


def _rotation(vector_rad: np.ndarray) -> np.ndarray:
    """Return (3, 3) rotation about `vector_rad` by its length."""
    matrix, _ = cv2.Rodrigues(vector_rad)
    return np.asarray(matrix)
