"""Every object and detection is counted once, with the reason why it does not count."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.kitti_devkit import HEIGHTS, OCCLUSIONS, TRUNCATIONS
from support.kitti_scenes import car, random_frames, to_objects

from curate.errors import ConfigError
from curate.evaluation.counts import Counts, describe_others
from curate.evaluation.kitti_ap import evaluate
from curate.evaluation.kitti_rules import (
    MIN_OVERLAPS,
    RELAXED_OVERLAPS,
    neighbours_of,
    overlaps_of,
    relaxed,
)

NAMES = ("Car", "Van", "Pedestrian", "Person_sitting", "Cyclist", "Misc")


def reason_of(item, level, is_label):
    """Return why an object of an evaluated category does not count, rule by rule."""
    height = item["box_2d"][3] - item["box_2d"][1]
    if height <= 0:
        return "no 2D box"
    if height < HEIGHTS[level] or (is_label and height == HEIGHTS[level]):
        return "too small"
    if is_label and item["occluded"] > OCCLUSIONS[level]:
        return "occluded"
    if is_label and item["truncated"] > TRUNCATIONS[level]:
        return "truncated"
    return "counts"


@settings(max_examples=40)
@given(
    st.integers(0, 2**32 - 1),
    st.lists(st.sampled_from(NAMES), min_size=1, max_size=4, unique=True),
)
def test_the_counts_equal_those_of_a_loop_and_add_up(seed, evaluated):
    """Counted, ignored by reason, neighbours, not evaluated and DontCare are all objects."""
    generator = np.random.default_rng(seed)
    labels, results = random_frames(generator, 6)
    for frame in (*labels, *results):
        for item in frame:
            if generator.random() < 0.2:
                item["box_2d"] = (0.0, 0.0, 0.0, 0.0)
    found = evaluate(
        [to_objects(frame) for frame in labels],
        [to_objects(frame) for frame in results],
        min_overlaps=dict.fromkeys(evaluated, 0.5),
    )
    neighbours = {"Car": "Van", "Pedestrian": "Person_sitting"}
    beside = {neighbours[name] for name in evaluated if name in neighbours} - set(evaluated)
    for frames, counts, is_label in (
        (labels, found.counts, True),
        (results, found.result_counts, False),
    ):
        items = [item for frame in frames for item in frame]
        for each in counts.categories:
            own = [item for item in items if item["category"] == each.category]
            assert each.total == len(own)
            for level in range(3):
                expected = Counter(reason_of(item, level, is_label) for item in own)
                assert each.counted[level] == expected.pop("counts", 0)
                ignored = {name: numbers[level] for name, numbers in each.ignored.items()}
                assert {name: n for name, n in ignored.items() if n} == expected
                assert each.counted[level] + sum(ignored.values()) == each.total
        others = Counter(
            item["category"]
            for item in items
            if item["category"] not in evaluated and item["category"] != "DontCare"
        )
        assert counts.neighbours == {n: c for n, c in others.items() if is_label and n in beside}
        assert counts.not_evaluated == {
            n: c for n, c in others.items() if n not in counts.neighbours
        }
        assert counts.total + counts.dont_care == len(items)
        assert counts.as_dict()["total"] == counts.total


def test_others_are_described():
    """With their numbers and why they are in no row."""
    counts = Counts(("all",), (), {"Van": 4}, {"Tram": 2}, 3)
    assert list(describe_others(counts)) == [
        "4 Van (neighbour)",
        "2 Tram (not evaluated)",
        "3 DontCare",
    ]


def test_a_neighbour_that_is_evaluated_is_not_ignored():
    """Van as a category of its own: a car on a van is then a false positive."""
    labels = [to_objects([car(), car(x=6, category="Van")])]
    results = [to_objects([car(score=0.5), car(x=6, score=0.9)])]
    alone = evaluate(labels, results, min_overlaps={"Car": 0.7})
    both = evaluate(labels, results, min_overlaps={"Car": 0.7, "Van": 0.7})
    assert alone.ap_r40[0, 3].tolist() == [100, 100, 100]
    assert both.ap_r40[0, 3].tolist() == [50, 50, 50]
    assert neighbours_of(("Car", "Van", "Pedestrian")) == {"Pedestrian": "Person_sitting"}


def test_the_iou_thresholds_of_any_category():
    """KITTI's, 0.5 for others, or the given ones."""
    assert overlaps_of(("Car", "Bus")) == {"Car": 0.7, "Bus": 0.5}
    assert overlaps_of(("Car", "Bus"), {"Bus": 0.7}) == {"Car": 0.7, "Bus": 0.7}
    with pytest.raises(ConfigError, match=r"'Buss' is not one of .*did you mean 'Bus'"):
        overlaps_of(("Car", "Bus"), {"Buss": 0.7})
    for wrong in (0, 1, -0.5, float("nan")):
        with pytest.raises(ConfigError, match="the IoU of Car must be above 0 and below 1"):
            overlaps_of(("Car",), {"Car": wrong})


def test_relaxed_thresholds_are_those_usual_for_kitti():
    """0.7 to 0.5 and 0.5 to 0.25; a lower threshold stays lower."""
    assert dict(RELAXED_OVERLAPS) == {"Car": 0.5, "Pedestrian": 0.25, "Cyclist": 0.25}
    assert relaxed(MIN_OVERLAPS) == dict(RELAXED_OVERLAPS)
    found = list(relaxed({str(i): i / 20 for i in range(1, 20)}).values())
    assert found == sorted(found)
    assert all(new < i / 20 for i, new in enumerate(found, start=1))
