"""Audited frames as columns, and the ranges of distance and points."""

import numpy as np
import pytest
from support.audited import six_labels

from curate.detections import Annotations, Detections, as_categories
from curate.evaluation.evaluated_labels import (
    WHOLE,
    AuditedFrame,
    EvaluatedLabels,
    Slice,
    evaluate_frames,
    slices,
)
from curate.evaluation.reliability import MatchSettings


def frame(labels, truth, categories=None):
    """Return a frame of cars at x and y; the annotations are cars by default."""

    def boxes(places):
        return np.array([[x, y, 0, 4, 2, 1.5, 0] for x, y in places], dtype=float).reshape(-1, 7)

    n, m = len(labels), len(truth)
    return AuditedFrame(
        Detections(boxes(labels), np.linspace(0.9, 0.5, n), as_categories(["Car"] * n)),
        Annotations(
            boxes(truth),
            as_categories(["Car"] * m if categories is None else categories),
            np.zeros(m),
            np.zeros(m, dtype=np.int64),
            np.zeros(m),
            np.zeros((m, 4)),
        ),
        np.full((n, 4), np.nan),
        np.arange(n, dtype=np.float64),
    )


def test_frames_become_columns():
    """A correct, a wrong and a neutral label; a missed object; an empty frame."""
    found = evaluate_frames(
        [
            frame([(3, 4), (30, 0)], [(3, 4)]),
            frame([], []),
            frame([(20, 0)], [(20, 0), (0, 12)], ["Van", "Car"]),
        ],
        MatchSettings(),
    )
    assert found.frames == 3
    assert found.frame_index.tolist() == [0, 0, 2]
    assert found.distance.tolist() == [5, 30, 20]
    assert found.correct.tolist() == [True, False, False]
    assert found.counted.tolist() == [True, True, False]
    assert found.points.tolist() == [0, 1, 0]
    assert found.object_frame.tolist() == [0, 2]
    assert found.object_category.tolist() == ["Car", "Car"]
    assert found.object_distance.tolist() == [5, 12]


def test_parts_are_joined_frame_after_frame():
    """The frames of the second part come after all of the first, empty ones included."""
    whole = EvaluatedLabels.joined([six_labels(), six_labels()])
    assert whole.frames == 6
    assert whole.frame_index.tolist() == [0, 0, 1, 1, 1, 1, 3, 3, 4, 4, 4, 4]
    assert whole.object_frame.tolist() == [0, 0, 1, 1, 2, 3, 3, 4, 4, 5]
    assert whole.category.tolist() == 2 * six_labels().category.tolist()


def test_no_frames_give_empty_columns():
    found = evaluate_frames([], MatchSettings())
    assert (found.frames, len(found), len(found.object_frame)) == (0, 0, 0)


def test_an_edge_belongs_to_the_range_above_it():
    """20 m is in 20-40 m; the last range is open."""
    by_distance = [part for part in slices(six_labels()) if part.by == "distance"]
    contained = [part.holds(np.array([0.0, 20, 39.9, 40, 300])).tolist() for part in by_distance]
    assert np.array(contained).sum(axis=0).tolist() == [1] * 5
    assert contained[1] == [False, True, True, False, False]
    assert [str(part) for part in (WHOLE, *by_distance)] == ["all", "0-20 m", "20-40 m", "40+ m"]
    assert str(Slice("points", 10, 50)) == "10-50"


@pytest.mark.parametrize(("points", "kinds"), [((5.0,) * 6, 2), ((np.nan,) * 6, 1)])
def test_points_are_used_only_if_they_were_counted(points, kinds):
    """Only the point prior counts them."""
    assert len({part.by for part in slices(six_labels(points))}) == kinds
