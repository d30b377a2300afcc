"""The choice of frames to label next, against figures worked out by hand and a slow search."""

from itertools import combinations
from math import sqrt

import numpy as np
import pytest

from curate.review.next_frames import (
    CandidateLabels,
    FrameGains,
    choose_frames,
    frame_gains,
)


def gains(amount: list[list[float]], boxes: list[float]) -> FrameGains:
    """Return gains with these amounts, as changes of weights."""
    change = np.array(amount, dtype=np.float64).reshape(len(boxes), -1 if boxes else 1)
    nothing = np.zeros_like(change)
    return FrameGains(change, nothing, np.array(boxes, dtype=np.float64), nothing.astype(np.int64))


def names(found: list) -> list[int]:
    """Return the numbers of the chosen frames."""
    return [choice.frame for choice in found]


def test_the_gains_of_labels_by_hand() -> None:
    """Two labels of frame 0, one of frame 2; nobody doubts a certain label of weight 1."""
    labels = CandidateLabels(
        frame=np.array([0, 0, 2]),
        category=np.array([1, 0, 1]),
        score=np.array([0.6, 1.0, 0.3]),
        weight=np.array([0.5, 1.0, 0.0]),
        probability=np.array([0.8, 1.0, 0.1]),
    )
    found = frame_gains(labels, 3, 2)
    assert found.change == pytest.approx(np.array([[0, 0.5], [0, 0], [0, 0.1]]))
    expected = 0.8 * 0.4**2 + 0.2 * 0.6**2
    assert found.error == pytest.approx(
        np.array([[0, expected], [0, 0], [0, 0.1 * 0.7**2 + 0.9 * 0.3**2]])
    )
    assert found.boxes == pytest.approx([1.8, 0, 0.1])
    assert found.doubtful.tolist() == [[0, 1], [0, 0], [0, 0]]


def test_the_first_choice_is_the_largest_gain_per_box() -> None:
    """4 in 6 boxes is less than 3 in 3; the fixed effort of a frame turns it round."""
    two = gains([[4.0], [3.0]], [6.0, 3.0])
    objects = np.array([1.0])
    [first] = choose_frames(two, 1, objects, frame_cost=0)
    assert (first.frame, first.gain) == (1, pytest.approx((sqrt(4) - 1) / 3))
    assert names(choose_frames(two, 1, objects, frame_cost=30)) == [0]


def test_categories_with_few_labels_come_first() -> None:
    """The same doubt counts more where only 4 objects are labeled than where 100 are."""
    two = gains([[2.0, 0], [0, 2.0]], [1.0, 1.0])
    assert names(choose_frames(two, 2, np.array([100.0, 4]))) == [1, 0]


def test_the_choices_spread_over_categories() -> None:
    """After a frame full of cars, a frame with fewer pedestrians adds more than another one."""
    three = gains([[9.0, 0], [8.0, 0], [0, 5.0]], [1.0, 1.0, 1.0])
    assert names(choose_frames(three, 3, np.array([1.0, 1]))) == [0, 2, 1]


def test_the_choices_spread_over_sequences() -> None:
    """A second frame of a sequence counts half, also after a labeled one."""
    three = gains([[5.0], [4.9], [3.0]], [1.0, 1.0, 1.0])
    objects = np.array([1.0])
    found = choose_frames(three, 3, objects, ["a", "a", "b"])
    assert names(found) == [0, 2, 1]
    assert [choice.of_sequence for choice in found] == [0, 0, 1]
    assert names(choose_frames(three, 1, objects, ["a", "a", "b"], ["a"])) == [2]


def test_no_more_frames_than_there_are() -> None:
    """Frames without labels are the last."""
    some = gains([[0.0], [1.0], [0.0]], [0.0, 1.0, 0.0])
    assert names(choose_frames(some, 9, np.array([0.0]))) == [1, 0, 2]
    assert choose_frames(gains([], []), 3, np.zeros(0)) == []


def test_the_greedy_choice_is_nearly_the_best() -> None:
    """At equal cost at least 1 - 1/e of the best of all choices, in practice nearly all of it."""
    generator = np.random.default_rng(0)
    for _ in range(20):
        amount = generator.exponential(2, (8, 3)) * (generator.random((8, 3)) < 0.5)
        objects = generator.integers(0, 5, 3).astype(float)
        chosen = names(choose_frames(gains(amount.tolist(), [1.0] * 8), 3, objects))

        def value(frames: list[int], amount=amount, objects=objects) -> float:
            return np.sqrt(objects + amount[list(frames)].sum(axis=0)).sum()

        best = max(value(list(each)) for each in combinations(range(8), 3))
        nothing = np.sqrt(objects).sum()
        assert value(chosen) - nothing >= 0.9 * (best - nothing)
