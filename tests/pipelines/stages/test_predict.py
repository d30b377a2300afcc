"""Checks of what any detector returns."""

import numpy as np
import pytest

from curate.detections import Detections, as_categories
from curate.errors import ModelError
from pipelines.stages.predict import checked
from pipelines.workspace.config import make_config

BOXES = np.array([[12.0, 4.2, -0.8, 3.9, 1.6, 1.5, 0.1]] * 2)
CONFIG = make_config({"dataset": {"root": "data"}}, "test")


def found(scores: tuple[float, float], length: float = 3.9) -> Detections:
    """Return two cars."""
    boxes = BOXES * 1
    boxes[1, 3] = length
    return Detections(boxes, np.array(scores), as_categories(["Car", "Car"]))


@pytest.mark.parametrize(
    ("detections", "message"),
    [
        (found((6.5, -2.6)), r"scores from -2\.6 to 6\.5; a score is a probability in \[0, 1\]"),
        (found((0.5, 99.0)), r"scores from 0\.5 to 99; a score"),
        (found((0.5, np.nan)), "scores from nan to nan"),
        (found((0.5, 0.6), length=0.0), r"has no size: \[12\.0, 4\.2, -0\.8, 0\.0, 1\.6, 1\.5"),
    ],
)
def test_impossible_detections_of_a_users_class_are_rejected(detections, message):
    """Before they reach the database, also if the score is below the minimum."""
    with pytest.raises(ModelError, match=message):
        checked(detections, CONFIG)


def test_valid_detections_are_sorted_by_score():
    assert checked(found((0.5, 0.6)), CONFIG).scores.tolist() == [0.6, 0.5]
