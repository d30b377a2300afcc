"""The augmentation A of the method: flip, rotation about z and uniform scale, and its inverse."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from curate.errors import ConfigError
from curate.shapes import Float, Num


def wrap_angle(angle_rad: Num[np.ndarray, " *shape"] | np.floating) -> Float[np.ndarray, " *shape"]:
    """Return angles in radians, wrapped to (-pi, pi]; angles in this range stay unchanged."""
    angle_rad = np.asarray(angle_rad, dtype=np.float64)
    wrapped = np.pi - np.mod(np.pi - angle_rad, 2 * np.pi)
    # For an angle just above pi the remainder is rounded to 2 pi, and the result to -pi.
    wrapped = np.where(wrapped <= -np.pi, np.pi, wrapped)
    return np.where((angle_rad > -np.pi) & (angle_rad <= np.pi), angle_rad, wrapped)


@dataclass(frozen=True)
class Similarity:
    """A(x): first y := -y if `flip_y`, then a rotation about z, then all coordinates times `scale`.

    Attributes:
        flip_y: mirror over the x axis.
        rotation_rad: rotation about z, counter-clockwise, radians.
        scale: uniform scale, above 0.

    Raises:
        ConfigError: if the rotation is not finite, or the scale is not finite and positive.
    """

    flip_y: bool = False
    rotation_rad: float = 0.0
    scale: float = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.rotation_rad) and np.isfinite(self.scale) and self.scale > 0):
            raise ConfigError(
                f"a similarity needs a finite rotation and a positive scale, not "
                f"rotation {self.rotation_rad} rad and scale {self.scale}"
            )

    @classmethod
    def draw(
        cls,
        generator: np.random.Generator,
        *,
        flip_probability: float = 0.5,
        rotation_limit_rad: float = np.pi / 4,
        scale_range: tuple[float, float] = (0.95, 1.05),
    ) -> Self:
        """Return a random similarity, uniform in rotation and scale."""
        return cls(
            bool(generator.random() < flip_probability),
            float(generator.uniform(-rotation_limit_rad, rotation_limit_rad)),
            float(generator.uniform(*scale_range)),
        )

    @property
    def inverse_rotation(self) -> Float[np.ndarray, "3 3"]:
        """The (3, 3) flip and rotation of the inverse, without its scale."""
        return self._matrix().T / self.scale

    def apply_to_points(self, points: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n c"]:
        """Return A of (n, >=3) points, in the same dtype; further columns stay unchanged."""
        moved = points.copy()
        matrix = self._matrix().astype(points.dtype)
        # Column by column: a matrix product would wake all threads of BLAS for a millisecond of
        # work, and would round a point differently in another selection of points.
        moved[:, 0] = matrix[0, 0] * points[:, 0] + matrix[0, 1] * points[:, 1]
        moved[:, 1] = matrix[1, 0] * points[:, 0] + matrix[1, 1] * points[:, 1]
        moved[:, 2] *= matrix[2, 2]
        return moved

    def apply_to_boxes(self, boxes: Num[np.ndarray, "n 7"]) -> Float[np.ndarray, "n 7"]:
        """Return A of (n, 7) boxes."""
        moved = np.array(boxes, dtype=np.float64)
        moved[:, :3] = moved[:, :3] @ self._matrix().T
        moved[:, 3:6] *= self.scale
        yaw = -moved[:, 6] if self.flip_y else moved[:, 6]
        moved[:, 6] = wrap_angle(yaw + self.rotation_rad)
        return moved

    def invert_boxes(self, boxes: Num[np.ndarray, "n 7"]) -> Float[np.ndarray, "n 7"]:
        """Return A^-1 of (n, 7) boxes."""
        moved = np.array(boxes, dtype=np.float64)
        moved[:, :3] = moved[:, :3] @ self._matrix() / self.scale**2
        moved[:, 3:6] /= self.scale
        yaw = moved[:, 6] - self.rotation_rad
        moved[:, 6] = wrap_angle(-yaw if self.flip_y else yaw)
        return moved

    def _matrix(self) -> np.ndarray:
        """Return the (3, 3) matrix M with A(p) = M @ p; M^-1 is M^T divided by scale squared."""
        cos, sin = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        mirror = -1.0 if self.flip_y else 1.0
        return self.scale * np.array([[cos, -sin * mirror, 0], [sin, cos * mirror, 0], [0, 0, 1]])
