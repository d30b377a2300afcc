"""The difficulty of a dataset, counted by hand."""

import numpy as np
import pytest
from support.kitti_scenes import car, to_objects

from curate.evaluation.object_statistics import object_statistics


def test_objects_are_counted_by_difficulty_occlusion_truncation_and_distance() -> None:
    """Four cars in two frames: easy, occluded (moderate), truncated (hard), too small for any."""
    frames = [
        to_objects([car(x=3, z=4), car(z=10, occluded=1), car(z=30, category="Cyclist")]),
        to_objects([car(z=20, truncated=0.4), car(z=30, occluded=2, box_2d=(0, 0, 50, 20))]),
    ]
    found = object_statistics(frames, ("Car", "Cyclist", "Pedestrian"))
    cars = found["Car"]
    assert (cars.objects, cars.per_frame) == (4, 2.0)
    assert cars.counted == (0.5, 1.0, 1.5)
    assert (cars.occluded, cars.mostly_occluded, cars.truncated) == (0.5, 0.25, 0.25)
    assert cars.distances[1] == pytest.approx(15)  # of 5, 10, 20, 30
    assert found["Cyclist"].objects == 1
    assert found["Pedestrian"].objects == 0
    assert np.isnan(found["Pedestrian"].occluded)


def test_a_van_is_not_a_car() -> None:
    """KITTI ignores it in the evaluation, so it makes nothing harder."""
    found = object_statistics([to_objects([car(category="Van")])], ("Car",))
    assert found["Car"].objects == 0
