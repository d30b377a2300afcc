"""The density prior: the visible area of a box, and the points expected there."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from support.toys import IMAGE_SIZE, toy_calibration

from curate.detections import Detections, as_categories
from curate.errors import ConfigError
from curate.frames import Frame
from curate.geometry.boxes import box_corners
from curate.priors.density import CONE_RAD, DensityPrior, expected_densities, visible_areas

STEP = np.deg2rad(0.2)


def labels(*boxes: list[float]) -> Detections:
    """Return cars with score 1."""
    table = np.array(boxes, dtype=np.float64).reshape(-1, 7)
    return Detections(table, np.ones(len(table)), as_categories(["Car"] * len(table)))


def frame(points: np.ndarray) -> Frame:
    """Return a sweep of (n, 3) points."""
    sweep = np.column_stack([points, np.zeros(len(points))]).astype(np.float32)
    return Frame("x", sweep, toy_calibration(), IMAGE_SIZE)


def wall(distance: float, half_width_rad: float = 0.3) -> np.ndarray:
    """Return a wall across x, seen by a sensor with one ray every 0.2 degrees."""
    angles = np.arange(-half_width_rad, half_width_rad, STEP)
    azimuth, elevation = (each.ravel() for each in np.meshgrid(angles, angles))
    rays = np.stack([np.ones_like(azimuth), np.tan(azimuth), np.tan(elevation)], axis=1)
    return distance * rays


@given(
    st.tuples(st.floats(-40, 40), st.floats(-40, 40), st.floats(-3, 3)),
    st.tuples(st.floats(0.3, 12), st.floats(0.3, 4), st.floats(0.3, 4)),
    st.floats(-np.pi, np.pi),
)
def test_the_visible_area_is_that_of_the_outline(centre, size, yaw) -> None:
    """The corners, projected along the line of sight, have a convex hull of that area."""
    if np.linalg.norm(centre) <= np.linalg.norm(size):
        return
    box = np.array([[*centre, *size, yaw]])
    sight = np.array(centre) / np.linalg.norm(centre)
    across = np.linalg.svd(sight[None])[2][1:]
    hull = ConvexHull(box_corners(box)[0] @ across.T)
    assert visible_areas(box)[0] == pytest.approx(hull.volume, rel=1e-6)


@pytest.mark.parametrize("distance", [8.0, 20.0, 45.0])
def test_a_wall_has_the_expected_points_at_every_range(distance: float) -> None:
    """Density falls with the square of the range, and so does the expectation."""
    side = 0.1 * distance
    plate = [distance, 0.0, 0.0, 0.02, side, side, 0.0]
    prior = DensityPrior()
    found = prior.score(frame(wall(distance)), labels(plate))
    assert found["visible_area"][0] == pytest.approx(side**2, rel=0.01)
    assert found["density"][0] == pytest.approx(found["expected_density"][0], rel=0.15)
    assert found["expected_density"][0] == pytest.approx(1 / (STEP * distance) ** 2, rel=0.05)
    assert found["rho_density"][0] == 1.0


def test_a_mostly_hidden_box_has_less_trust() -> None:
    """A quarter of the points, half of the expectation needed: half the trust."""
    points = wall(20.0)
    plate = [20.0, 0.0, 0.0, 0.02, 1.2, 1.2, 0.0]
    inside = (np.abs(points[:, 1]) <= 0.6) & (np.abs(points[:, 2]) <= 0.6)
    kept = ~inside | (np.cumsum(inside) % 4 == 0)
    whole = DensityPrior().score(frame(points), labels(plate))
    sparse = DensityPrior().score(frame(points[kept]), labels(plate))
    assert sparse["density"][0] == pytest.approx(whole["density"][0] / 4, rel=0.05)
    assert 0.4 < sparse["rho_density"][0] < 0.75
    strict = DensityPrior(share=1.0).score(frame(points[kept]), labels(plate))
    assert strict["rho_density"][0] == pytest.approx(sparse["rho_density"][0] / 2)


def test_without_expected_points_the_trust_is_full() -> None:
    """An empty sweep, a cone without points, a box around the sensor."""
    around, behind = [0.1, 0.0, 0.0, 4.0, 2.0, 1.5, 0.3], [-20.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.3]
    for points in (np.zeros((0, 3)), wall(20.0)):
        found = DensityPrior().score(frame(points), labels(around, behind))
        assert found["rho_density"].tolist() == [1.0, 1.0]
        assert found["visible_area"][0] == 0.0
        assert np.isnan(found["density"]).tolist() == [True, False]
        assert np.isnan(found["expected_density"]).all()
    assert len(DensityPrior().score(frame(wall(20.0)), labels())["rho_density"]) == 0


def test_the_cone_has_its_width() -> None:
    """A point just inside counts, one just outside does not."""
    box = np.array([[10.0, 0, 0, 4, 2, 1.5, 0]])
    for angle, found in ((0.99 * CONE_RAD, 1), (1.01 * CONE_RAD, 0)):
        points = np.array([[np.cos(angle), np.sin(angle), 0.0]])
        assert np.isfinite(expected_densities(points, box)).sum() == found


@pytest.mark.parametrize("share", [0.0, -1.0, float("nan")])
def test_a_zero_or_negative_share_is_rejected(share: float) -> None:
    """It divides the density."""
    with pytest.raises(ConfigError, match="share must be above 0"):
        DensityPrior(share=share)
