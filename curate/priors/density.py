"""Evidence from point density: LiDAR points per square metre that the sensor sees of a box.

The point prior compares the count of points with labeled boxes of the category, so a far object is
trusted less than a near one. Here the sweep itself says what the range would give. Let u be the
direction from the sensor (the origin of the LiDAR frame) to the box centre at range r:

    visible_area      a = sum over the six faces of A_f * max(0, -n_f . u), in m2: the area of the
                      faces that are turned to the sensor, projected along u (n_f: outward normal)
    density           m / a, with m points in the box
    expected_density  q / r^2, with q the points per steradian of the sweep within `CONE_RAD` of u

A solid object of projected area a covers the solid angle a / r^2, so it should return about
q * a / r^2 points. Occlusion, dark paint and gaps leave fewer: rho is 1 from `share` of the
expectation on, and falls in proportion below it.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from curate.detections import Detections
from curate.errors import ConfigError
from curate.frames import Frame
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.priors.base import Column, Evidence, EvidenceSource, Measured
from curate.shapes import Float

CONE_RAD = np.deg2rad(4.0)
"""Half the opening of the cone around a box in which the sweep's density is measured."""


@dataclass(frozen=True)
class DensityPrior(EvidenceSource):
    """rho_density = min(1, density / (share * expected_density)); 1 where nothing is expected.

    Attributes:
        share: of the expected density from which on a label is fully trusted, above 0.
    """

    share: float = 0.5
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
        """Raise ConfigError where the share is not a positive number."""
        if not (np.isfinite(self.share) and self.share > 0):
            raise ConfigError(f"density prior: share must be above 0, not {self.share}")

    def measure(self, frame: Frame, detections: Detections) -> Measured:
        """Return visible area, density and expected density of each box.

        A box around the sensor has no visible area, and no density; where the cone around a box
        holds no point of the sweep, nothing is expected.
        """
        boxes = detections.boxes
        area = visible_areas(boxes)
        count = count_points_in_boxes(frame.points, boxes)
        seen = area > 0
        density = np.full(len(boxes), np.nan)
        density[seen] = count[seen] / area[seen]
        expected = np.where(seen, expected_densities(frame.points, boxes), np.nan)
        return {"visible_area": area, "density": density, "expected_density": expected}

    def rate(self, detections: Detections, measured: Measured) -> Evidence:  # noqa: ARG002
        """Compare the density with the expected one."""
        density, expected = measured["density"], measured["expected_density"]
        known = np.isfinite(density) & np.isfinite(expected)
        rho = np.ones(len(density))
        rho[known] = np.minimum(density[known] / (self.share * expected[known]), 1.0)
        return {**measured, "rho_density": rho}


def visible_areas(boxes: Float[np.ndarray, "n 7"]) -> Float[np.ndarray, " n"]:
    """Return the area of each box as seen from the origin, projected along the line of sight.

    Args:
        boxes: (n, 7) in the LiDAR frame.

    Returns:
        (n,) m2; 0 for a box that holds the origin.
    """
    centres, (length, width, height) = boxes[:, :3], boxes[:, 3:6].T
    cos, sin = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    distance = np.linalg.norm(centres, axis=1)
    sight = centres / np.maximum(distance, np.finfo(np.float64).tiny)[:, None]
    # Of two opposite faces one is turned to the sensor: its share is |n . u|.
    ahead = np.abs(sight[:, 0] * cos + sight[:, 1] * sin)
    aside = np.abs(sight[:, 1] * cos - sight[:, 0] * sin)
    upward = np.abs(sight[:, 2])
    area = width * height * ahead + length * height * aside + length * width * upward
    x = np.abs(centres[:, 0] * cos + centres[:, 1] * sin)
    y = np.abs(centres[:, 1] * cos - centres[:, 0] * sin)
    around = (x <= length / 2) & (y <= width / 2) & (np.abs(centres[:, 2]) <= height / 2)
    return np.where(around, 0.0, area)


def expected_densities(
    points: Float[np.ndarray, "m _"], boxes: Float[np.ndarray, "n 7"]
) -> Float[np.ndarray, " n"]:
    """Return the density that the sweep gives at the range and in the direction of each box.

    Args:
        points: (m, >=3) the sweep, LiDAR frame.
        boxes: (n, 7) in the LiDAR frame.

    Returns:
        (n,) points per m2 across the line of sight; NaN where the cone around a box is empty.
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
