"""The camera's mounting: a calibration in KITTI's format that varies slightly between scenes."""

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np

from curate.frames import Calibration
from curate.simulation.shading import pixel_rays

IMAGE_SIZE = (1242, 375)
"""Width and height in pixels."""

# Typical of KITTI's recordings: the camera looks along the LiDAR's x axis. It is 27 cm in front of
# the LiDAR and 8 cm below it, with a remaining rotation of less than one degree.
_AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
_TRANSLATION_M = np.array([-0.004, -0.076, -0.272])
_ROTATION_RAD = np.array([0.0148, -0.0075, 0.0007])
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
        """Return a random rig similar to KITTI's."""
        focal = generator.uniform(707, 722)
        centre = np.array([609.0, 175.0]) + generator.normal(0, (3, 2.5))
        projection = np.array(
            [
                [focal, 0, centre[0], generator.normal(45, 0.5)],
                [0, focal, centre[1], generator.normal(0.2, 0.1)],
                [0, 0, 1, 0.0027],
            ]
        )
        rotation = _ROTATION_RAD + generator.normal(0, 0.003, size=3)
        rectify = _RECTIFICATION_RAD + generator.normal(0, 0.0015, size=3)
        translation = _TRANSLATION_M + generator.normal(0, 0.01, size=3)
        extrinsic = np.column_stack([_rotation(rotation) @ _AXES, translation])
        return cls(projection, _rotation(rectify), extrinsic)

    @property
    def calibration(self) -> Calibration:
        """The calibration as data set readers return it."""
        lidar_to_camera = np.eye(4)
        lidar_to_camera[:3] = self.rectification @ self.extrinsic
        return Calibration(self.projection, lidar_to_camera)

    def kitti_text(self) -> str:
        """Return the content of a KITTI calibration file; P0, P1 and P3 repeat P2."""
        matrices = dict.fromkeys(("P0", "P1", "P2", "P3"), self.projection)
        matrices["R0_rect"] = self.rectification
        matrices["Tr_velo_to_cam"] = self.extrinsic
        matrices["Tr_imu_to_velo"] = np.eye(4)[:3]
        return "".join(
            f"{key}: {' '.join(f'{number:.12e}' for number in matrix.ravel())}\n"
            for key, matrix in matrices.items()
        )

    def pixel_geometry(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the geometry of the pixel rays in the LiDAR frame.

        Returns:
            (3, 3) matrix from homogeneous pixels to ray directions, and (3,) camera centre.
        """
        matrix = self.calibration.lidar_to_image
        inverse = np.linalg.inv(matrix[:, :3])
        return inverse, -inverse @ matrix[:, 3]

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Return the rays through pixel centres in the LiDAR frame.

        Args:
            pixels: (n,) row * width + column.

        Returns:
            (n, 6) float32: origin and unit direction.
        """
        return np.asarray(pixel_rays(*self.pixel_geometry(), pixels, IMAGE_SIZE[0]))


def _rotation(vector_rad: np.ndarray) -> np.ndarray:
    """Return the (3, 3) rotation about the axis `vector_rad` by its length in radians."""
    matrix, _ = cv2.Rodrigues(vector_rad)
    return np.asarray(matrix)
