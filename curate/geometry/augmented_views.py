"""The augmented copies A(x) of a frame: which similarities are drawn, and the copies themselves.

A copy has a calibration of its own, such that A(x) is projected to the very pixels of x. The
transform from LiDAR to camera stays rigid, so that every reader accepts it:

- x = (1/s) F R^T y for a point y = s R F x of the copy, with the rotation R and the flip F.
- A camera point is Q x + t. Times s it is Q F R^T y + s t, and P with its fourth column times s
  projects it to the same pixel.
- With a flip, Q F R^T mirrors. The mirror G = diag(-1, 1, 1) makes it a rotation again: G Q F R^T
  and s G t. P with its first column negated takes G back.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from curate.errors import ConfigError
from curate.frames import Calibration, Frame
from curate.geometry.similarity import Similarity


@dataclass(frozen=True)
class AugmentedViews:
    """The augmented copies of a round; the same values give the same copies.

    Attributes:
        seed: random seed.
        round_number: number of the round, from 1.
        views: number of copies of each frame.
        flip_probability: probability that a copy is flipped over the x axis.
        rotation_limit_rad: a copy is rotated about z by at most this angle, in either direction.
        scale_range: limits of the factor by which a copy is scaled.

    Raises:
        ConfigError: if a value is invalid.
    """

    seed: int = 0
    round_number: int = 1
    views: int = 1
    flip_probability: float = 0.5
    rotation_limit_rad: float = np.pi / 4
    scale_range: tuple[float, float] = (0.95, 1.05)

    def __post_init__(self) -> None:
        """Check the values."""
        if min(self.seed, self.round_number, self.views - 1) < 0:
            raise ConfigError(
                f"copies of seed {self.seed}, round {self.round_number}, {self.views} views: seed "
                "and round must not be negative, and there must be a view"
            )
        low, high = self.scale_range
        if not (0 <= self.flip_probability <= 1 and self.rotation_limit_rad >= 0 < low <= high):
            raise ConfigError(
                f"copies with flip_probability {self.flip_probability}, rotation_limit_rad "
                f"{self.rotation_limit_rad}, scale_range {list(self.scale_range)}: the first must "
                "be in [0, 1], the second not negative, the third two rising positive factors"
            )

    def draw(self, frame_id: str) -> list[Similarity]:
        """Return A of each copy of a frame."""
        digest = hashlib.sha256(frame_id.encode()).digest()
        generator = np.random.default_rng([self.seed, self.round_number, *digest])
        return [
            Similarity.draw(
                generator,
                flip_probability=self.flip_probability,
                rotation_limit_rad=self.rotation_limit_rad,
                scale_range=self.scale_range,
            )
            for _ in range(self.views)
        ]

    def copies(self, frame: Frame) -> Iterator[tuple[Similarity, Frame]]:
        """Yield A and the copy A(x) of each view of a frame."""
        for similarity in self.draw(frame.frame_id):
            yield similarity, augmented_frame(frame, similarity)


def augmented_frame(frame: Frame, similarity: Similarity) -> Frame:
    """Return A(x): the frame with transformed points, and calibrations that fit them.

    The images are those of the frame.
    """
    moved = frame.with_points(similarity.apply_to_points(frame.points))
    if not frame.cameras:
        return replace(moved, calibration=augmented_calibration(frame.calibration, similarity))
    return moved.with_cameras(
        [
            replace(camera, calibration=augmented_calibration(camera.calibration, similarity))
            for camera in frame.cameras
        ]
    )


def augmented_calibration(calibration: Calibration, similarity: Similarity) -> Calibration:
    """Return the calibration of the copy A(x); see the head of the module.

    The pose in the map stays, so the copy has a map of its own. Data without a camera keep their
    calibration, which is that of labels in KITTI's form.
    """
    if not calibration.has_camera:
        return calibration
    mirror = np.diag([-1.0 if similarity.flip_y else 1.0, 1.0, 1.0])
    to_camera = np.eye(4)
    to_camera[:3, :3] = mirror @ calibration.lidar_to_camera[:3, :3] @ similarity.inverse_rotation
    to_camera[:3, 3] = similarity.scale * mirror @ calibration.lidar_to_camera[:3, 3]
    projection = calibration.projection.copy()
    projection[:, :3] = projection[:, :3] @ mirror
    projection[:, 3] *= similarity.scale
    return replace(calibration, projection=projection, lidar_to_camera=to_camera)
