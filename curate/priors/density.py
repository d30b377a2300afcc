"""The density prior: LiDAR points per visible area of a box, compared with the sweep around it.

The point prior compares the number of points with labeled boxes of the category, so it trusts a far
object less than a near one. The density prior takes the expected density from the sweep itself.
Let u be the direction from the sensor (the origin of the LiDAR frame) to the box centre at range r:

    visible_area      a = sum over the six faces of A_f * max(0, -n_f . u), in m2: the area of the
                      faces that face the sensor, projected along u (n_f: outward normal)
    density           m / a, with m points in the box
    expected_density  q / r^2, with q the points per steradian of the sweep within `CONE_RAD` of u

A solid object of projected area a covers the solid angle a / r^2, so it should return about
q * a / r^2 points. Occlusion, dark paint and gaps reduce this number. rho is 1 if the density is at
least `share` times the expected density; below that it is proportional to the density.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from curate.detections import Detections
from curate.errors import ConfigError
from curate.frames import Frame
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.priors.base import Column, Evidence, EvidenceSource, Measured
from curate.ranges import AboveZero
from curate.shapes import Float

CONE_RAD = np.deg2rad(4.0)
"""Half the opening angle of the cone around a box in which the sweep's density is measured."""


@dataclass(frozen=True)
class DensityPrior(EvidenceSource):
    """rho_density = min(1, density / (share * expected_density)); 1 without an expected density.

    Attributes:
        share: share of the expected density at which rho_density reaches 1, above 0.
    """

    share: AboveZero = 0.5
    name: ClassVar[str] = "density"
    columns: ClassVar[tuple[Column, ...]] = (
        Column("visible_area", "float64", "m2", "area of the box as the LiDAR sees it"),
        Column("density", "float64", "1/m2", "LiDAR points in the box per visible area", True),
        Column("expected_density", "float64", "1/m2", "what the sweep gives at that range", True),
        Column("rho_density", "float64", "1", "density prior: density against the expected one"),
    )
    rho_column: ClassVar[str | None] = "rho_density"
    measured_columns: ClassVar[tuple[str, ...]] = ("visible_area", "density", "expected_density")

    def __post_init__(self) -> None:
        """Raise ConfigError if the share is not a positive number."""
        if not (np.isfinite(self.share) and self.share > 0):
            raise ConfigError(f"density prior: share must be above 0, not {self.share}")

    def measure(self, frame: Frame, detections: Detections) -> Measured:
        """Return visible area, density and expected density of each box.

        A box around the sensor has visible area 0 and no density. If the cone around a box contains
        no point of the sweep, the box has no expected density.
        """
        boxes = detections.boxes
        area = visible_areas(boxes)
        count = count_points_in_boxes(frame.points, boxes)
        visible = area > 0
        density = np.full(len(boxes), np.nan)
        density[visible] = count[visible] / area[visible]
        expected = np.where(visible, expected_densities(frame.points, boxes), np.nan)
        return {"visible_area": area, "density": density, "expected_density": expected}

    def rate(self, detections: Detections, measured: Measured) -> Evidence:  # noqa: ARG002
        """Return the measured columns and rho_density."""
        density, expected = measured["density"], measured["expected_density"]
        finite = np.isfinite(density) & np.isfinite(expected)
        rho = np.ones(len(density))
        rho[finite] = np.minimum(density[finite] / (self.share * expected[finite]), 1.0)
        return {**measured, "rho_density": rho}


def visible_areas(boxes: Float[np.ndarray, "n 7"]) -> Float[np.ndarray, " n"]:
    """Return the area of each box as seen from the origin, projected along the line of sight.

    Args:
        boxes: (n, 7) in the LiDAR frame.

    Returns:
        (n,) m2; 0 for a box that contains the origin.
    """
    centres, (length, width, height) = boxes[:, :3], boxes[:, 3:6].T
    cos, sin = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    distance = np.linalg.norm(centres, axis=1)
    direction = centres / np.maximum(distance, np.finfo(np.float64).tiny)[:, None]
    # One of two opposite faces faces the sensor; its projected area is A_f * |n . u|.
    forward = np.abs(direction[:, 0] * cos + direction[:, 1] * sin)
    sideways = np.abs(direction[:, 1] * cos - direction[:, 0] * sin)
    upward = np.abs(direction[:, 2])
    area = width * height * forward + length * height * sideways + length * width * upward
    x = np.abs(centres[:, 0] * cos + centres[:, 1] * sin)
    y = np.abs(centres[:, 1] * cos - centres[:, 0] * sin)
    contains_origin = (x <= length / 2) & (y <= width / 2) & (np.abs(centres[:, 2]) <= height / 2)
    return np.where(contains_origin, 0.0, area)


def expected_densities(
    points: Float[np.ndarray, "m _"], boxes: Float[np.ndarray, "n 7"]
) -> Float[np.ndarray, " n"]:
    """Return the point density of the sweep in the direction and at the range of each box.

    Args:
        points: (m, >=3) x, y, z of the sweep in metres in the LiDAR frame.
        boxes: (n, 7) in the LiDAR frame.

    Returns:
        (n,) points per m2 perpendicular to the line of sight; NaN if the cone around a box is
        empty.
    """
    rays = points[:, :3].astype(np.float64)
    lengths = np.linalg.norm(rays, axis=1)
    rays = rays[lengths > 0] / lengths[lengths > 0, None]
    solid_angle = 2 * np.pi * (1 - np.cos(CONE_RAD))
    expected = np.full(len(boxes), np.nan)
    for i, centre in enumerate(boxes[:, :3]):
        distance = float(np.linalg.norm(centre))
        if distance > 0:
            inside = np.count_nonzero(rays @ (centre / distance) >= np.cos(CONE_RAD))
            expected[i] = inside / solid_angle / distance**2 if inside else np.nan
    return expected
