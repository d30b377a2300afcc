"""Tracks: a Kalman filter with one-to-one assignment, forward and backward."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from curate.tracking import MAX_GAP_S, Sightings, track_numbers


def scene(*objects, times, length: float = 4.0, fixed: bool = True) -> tuple[Sightings, np.ndarray]:
    """Return the sightings of objects, and the true object of each.

    Args:
        objects: functions that return x, y of an object at a time; None while it is not seen.
        times: times of the frames.
        length: length of all boxes.
        fixed: see `Sightings`.
    """
    rows = [
        (step, *place, number)
        for step, time in enumerate(times)
        for number, place in enumerate(each(time) for each in objects)
        if place is not None
    ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    sightings = Sightings(
        table[:, 0].astype(np.int64),
        table[:, 1:3],
        np.full(len(table), length),
        np.asarray(times, dtype=np.float64),
        fixed,
    )
    return sightings, table[:, 3].astype(np.int64)


def moving(x: float, y: float, vx: float = 0.0, vy: float = 0.0, seen=lambda _time: True):
    """Return an object with constant velocity."""
    return lambda time: (x + vx * time, y + vy * time) if seen(time) else None


def same_partition(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two numberings form the same groups."""
    return bool(((one[:, None] == one) == (other[:, None] == other)).all())


TENTHS = np.arange(30) / 10


def test_known_tracks_are_found() -> None:
    """Parked, oncoming at 15 m/s, and crossing at 8 m/s."""
    sightings, truth = scene(
        moving(10, 4), moving(60, -3, vx=-15), moving(25, -20, vy=8), times=TENTHS
    )
    assert same_partition(track_numbers(sightings), truth)


def test_crossing_objects_keep_their_tracks() -> None:
    """They pass the point where their paths cross 0.1 s apart: velocity decides, not distance."""
    sightings, truth = scene(
        moving(0, 0, vx=4, vy=2), moving(0, 6.0, vx=4, vy=-2.05), times=TENTHS, length=1.8
    )
    assert same_partition(track_numbers(sightings), truth)


@pytest.mark.parametrize("missing", [1, 5, 9])
def test_missed_frames_do_not_end_a_track(missing: int) -> None:
    """The object moves on while it is not seen, for up to one second between two boxes."""
    hidden = moving(0, 0, vx=10, seen=lambda time: not 0.95 < time < 0.95 + missing / 10)
    sightings, truth = scene(hidden, times=TENTHS)
    assert same_partition(track_numbers(sightings), truth)


def test_a_track_ends_after_a_second_without_a_box() -> None:
    sightings, _ = scene(moving(0, 0), times=[0, 0.1, 0.1 + MAX_GAP_S, 1.3 + 2 * MAX_GAP_S])
    assert track_numbers(sightings).tolist() == [0, 0, 0, 1]


def test_clutter_does_not_join_a_track() -> None:
    """Boxes at random places 6 m or more from the object."""
    rng = np.random.default_rng(0)
    places = {round(10 * t): rng.uniform((0, 8), (60, 40)) for t in TENTHS}
    sightings, truth = scene(
        moving(10, 0, vx=5), lambda time: tuple(places[round(10 * time)]), times=TENTHS
    )
    found = track_numbers(sightings)
    assert len(np.unique(found[truth == 0])) == 1
    assert not set(found[truth == 0]) & set(found[truth == 1])


def test_one_frame_has_tracks_of_one_box_each() -> None:
    sightings, _ = scene(moving(0, 0), moving(3, 0), moving(3.1, 0), times=[5.0])
    assert sorted(track_numbers(sightings).tolist()) == [0, 1, 2]


def test_no_boxes_have_no_tracks() -> None:
    sightings, _ = scene(times=TENTHS)
    assert track_numbers(sightings).shape == (0,)


def test_assignment_has_the_lowest_total_cost() -> None:
    """Against all permutations: five parked objects in a row, all displaced towards a neighbour."""
    sightings, _ = scene(
        *(moving(2.0 * i, 0, vx=4) for i in range(5)), times=[0.0, 0.1], length=1.0
    )
    found = track_numbers(sightings).reshape(2, 5)
    cost = np.abs(sightings.positions[:5, None, 0] - sightings.positions[None, 5:, 0]) ** 2
    best = min(
        itertools.permutations(range(5)),
        key=lambda order: sum(cost[i, j] for i, j in enumerate(order)),
    )
    np.testing.assert_array_equal(found[0], found[1][list(best)])


@st.composite
def random_sightings(draw) -> Sightings:
    """Return boxes on a grid that is finer than the noise, at times that are exact in binary."""
    count = draw(st.integers(0, 24))
    integers = st.lists(st.integers(0, 120), min_size=count, max_size=count)
    steps = draw(st.lists(st.integers(0, 5), min_size=count, max_size=count))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    jitter = rng.uniform(0, 0.2, size=(count, 2))  # no two pairs of boxes at the same distance
    return Sightings(
        np.array(steps, dtype=np.int64),
        np.column_stack([draw(integers), draw(integers)]).reshape(-1, 2) / 8 + jitter,
        rng.uniform(1, 5, size=count),
        np.array([0, 0.125, 0.25, 0.5, 0.625, 2.0]),
        fixed=draw(st.booleans()),
    )


@settings(max_examples=60, deadline=None)
@given(random_sightings(), st.randoms(use_true_random=False))
def test_the_order_of_the_boxes_does_not_matter(sightings: Sightings, random) -> None:
    order = np.array(random.sample(range(len(sightings.steps)), len(sightings.steps)), dtype=int)
    shuffled = replace(
        sightings,
        steps=sightings.steps[order],
        positions=sightings.positions[order],
        lengths=sightings.lengths[order],
    )
    assert same_partition(track_numbers(shuffled), track_numbers(sightings)[order])


@settings(max_examples=60, deadline=None)
@given(random_sightings())
def test_a_reversed_sequence_has_the_same_tracks(sightings: Sightings) -> None:
    reverse = replace(sightings, steps=5 - sightings.steps, times=2.0 - sightings.times[::-1])
    assert same_partition(track_numbers(reverse), track_numbers(sightings))


@settings(max_examples=60, deadline=None)
@given(random_sightings())
def test_a_track_has_one_box_per_frame_and_no_gap_above_a_second(sightings: Sightings) -> None:
    found = track_numbers(sightings)
    for track in np.unique(found):
        steps = np.sort(sightings.steps[found == track])
        assert (np.diff(steps) > 0).all()
        assert (np.diff(sightings.times[steps]) <= MAX_GAP_S + 1e-6).all()
