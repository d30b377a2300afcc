"""Levels of difficulty: KITTI's against the devkit's rules, points and distance by brute force."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import kitti_devkit
from support.kitti_scenes import car, random_frames, to_objects

from curate.errors import ConfigError
from curate.evaluation.difficulties import (
    KITTI,
    REASONS,
    DistanceDifficulty,
    PointDifficulty,
    open_difficulty,
)
from curate.evaluation.kitti_ap import FIGURES, evaluate
from curate.evaluation.kitti_outcomes import object_outcomes

seeds = st.integers(0, 2**32 - 1)
OVERLAPS = {"Car": 0.5, "Pedestrian": 0.4, "Cyclist": 0.3}


def scene(seed, frames=8):
    """Return labels with a random number of points each, and results near them."""
    generator = np.random.default_rng(seed)
    labels, results = random_frames(generator, frames)
    labels = [
        [{**item, "points": int(generator.choice([0, 1, 3, 5, 6, 90]))} for item in frame]
        for frame in labels
    ]
    return labels, results


def assert_like_oracle(evaluation, labels, results, rules):
    """Compare BEV and 3D figures of every category with the slow oracle, a rule per level."""
    for c, (category, overlap) in enumerate(evaluation.min_overlaps.items()):
        for figure in ("bev", "3d"):
            for d, rule in enumerate(rules):
                frames = zip(labels, results, strict=True)
                counted = sum(
                    kitti_devkit.Frame(*pair, category, figure, rule, overlap).states.count(
                        "counted"
                    )
                    for pair in frames
                )
                assert evaluation.objects[c, d] == counted
                f = FIGURES.index(figure)
                got = evaluation.ap_r11[c, f, d], evaluation.ap_r40[c, f, d]
                if not counted:
                    assert np.isnan(got).all()
                    continue
                expected = kitti_devkit.average_precision(
                    labels, results, category, figure, rule, overlap
                )
                assert got == pytest.approx(expected, abs=1e-9), (category, figure, d)


@settings(max_examples=20)
@given(seeds)
def test_ranges_of_distance_equal_the_brute_force(seed):
    """Objects and unmatched detections by their own distance; a match goes with its object."""
    labels, results = scene(seed)
    evaluation = evaluate(
        [to_objects(frame) for frame in labels],
        [to_objects(frame) for frame in results],
        min_overlaps=OVERLAPS,
        difficulty=DistanceDifficulty((11.0, 13.0)),
        kit_sampling=True,
    )
    rules = [kitti_devkit.ByDistance(low, high) for low, high in ((0, 11), (11, 13), (13, np.inf))]
    assert_like_oracle(evaluation, labels, results, rules)


@settings(max_examples=20)
@given(seeds)
def test_levels_by_points_equal_the_brute_force(seed):
    """An object with fewer points is neither found nor missed; every detection counts."""
    labels, results = scene(seed)
    evaluation = evaluate(
        [to_objects(frame) for frame in labels],
        [to_objects(frame) for frame in results],
        min_overlaps=OVERLAPS,
        difficulty=PointDifficulty((6, 1)),
        points=[np.array([item["points"] for item in frame], dtype=np.int64) for frame in labels],
        kit_sampling=True,
    )
    rules = [kitti_devkit.ByPoints(least) for least in (6, 1)]
    assert_like_oracle(evaluation, labels, results, rules)


def test_a_detection_on_the_other_side_of_a_limit_still_matches_its_object():
    """The object is at 29.9 m, its detection at 30.1 m: found in the first range, false in none."""
    labels, results = [[car(z=29.9)]], [[car(z=30.1)]]
    found = evaluate(
        [to_objects(labels[0])],
        [to_objects(results[0])],
        difficulty=DistanceDifficulty((30.0,)),
    )
    assert found.ap_r40[0, FIGURES.index("3d")].tolist()[0] == 100
    assert np.isnan(found.ap_r40[0, FIGURES.index("3d"), 1])
    assert found.as_dict()["AP_R40"]["Car"]["image"] is None
    assert found.as_dict()["AP_R40"]["Car"]["aos"] is None


def test_boxes_without_a_2d_box_count_by_points_and_distance():
    """Neither needs a 2D box, occlusion or truncation."""
    bare = car(box_2d=(0, 0, 0, 0), occluded=3, truncated=1.0)
    labels = [to_objects([bare])]
    for difficulty, points in (
        (PointDifficulty(), [np.array([7])]),
        (DistanceDifficulty(), None),
    ):
        found = evaluate(labels, labels, difficulty=difficulty, points=points)
        assert found.objects[0, 0] == 1
        assert found.ap_r40[0, FIGURES.index("bev"), 0] == 100
    assert evaluate(labels, labels).objects.sum() == 0


@settings(max_examples=30)
@given(seeds, st.integers(0, 2))
def test_an_object_counts_for_kitti_exactly_if_it_has_no_reason(seed, level):
    """The states of the devkit's rules; the reason says which rule it was."""
    labels, results = random_frames(np.random.default_rng(seed), 5)
    for frame in labels:
        items = [item for item in frame if item["category"] == "Car"]
        reasons = KITTI.object_reasons(to_objects(items), level, None)
        for item, reason in zip(items, reasons, strict=True):
            state = kitti_devkit.label_state(item, "Car", level)
            assert (state == "counted") == (REASONS[reason] == "counts")
    for frame in results:
        reasons = KITTI.result_reasons(to_objects(frame), level)
        for item, reason in zip(frame, reasons, strict=True):
            state = kitti_devkit.result_state(item, item["category"], level)
            assert (state == "counted") == (REASONS[reason] == "counts")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({}, "counts"),
        ({"box_2d": (0, 0, 0, 0)}, "no 2D box"),
        ({"box_2d": (-1, -1, -1, -1)}, "outside the image"),
        ({"box_2d": (0, 0, 90, 25)}, "too small"),
        ({"occluded": 3}, "occluded"),
        ({"truncated": 0.6}, "truncated"),
        ({"occluded": 3, "truncated": 0.6, "box_2d": (0, 0, 0, 0)}, "no 2D box"),
        ({"occluded": -1, "truncated": -1.0}, "counts"),
    ],
)
def test_the_first_reason_is_given(change, reason):
    """One reason per object, so that the numbers add up; unknown (-1) occlusion counts."""
    [found] = KITTI.object_reasons(to_objects([car(**change)]), 2, None)
    assert REASONS[found] == reason


def test_detections_without_any_2d_box_give_no_figure():
    """Zeros: the file has no 2D boxes, nothing to compute. -1: all are outside the image."""
    labels = [to_objects([car()])]
    bare = [to_objects([car(box_2d=(0, 0, 0, 0))])]
    found = evaluate(labels, bare)
    assert np.isnan(found.ap_r40).all()
    assert found.objects[0].tolist() == [1, 1, 1]
    outside = evaluate(labels, [to_objects([car(box_2d=(-1, -1, -1, -1))])])
    assert outside.ap_r40[0, 2].tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("difficulty", "levels", "limits"),
    [
        (PointDifficulty((10, 1)), ("level 1", "level 2"), ("at least 10 LiDAR points", "1 LiDAR")),
        (DistanceDifficulty(()), ("0+ m",), ("from 0 m",)),
        (DistanceDifficulty((7.5,)), ("0-7.5 m", "7.5+ m"), ("below 7.5 m", "from 7.5 m")),
        (KITTI, ("easy", "moderate", "hard"), ("above 40 px", "above 25 px", "up to 0.5")),
    ],
)
def test_the_limits_are_stated(difficulty, levels, limits):
    """A name and a description for each level."""
    assert difficulty.levels == levels
    for text, part in zip(difficulty.limits(), limits, strict=True):
        assert part in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("hard",), "difficulty 'hard': use kitti, points or distance"),
        (("points", ()), "minimum points"),
        (("points", (1, 6)), "minimum points 1,6: give whole numbers from 1, the largest first"),
        (("points", (6, 0)), "minimum points 6,0"),
        (("distance", (6,), (50.0, 30.0)), "distances 50,30: give metres above 0, the smallest"),
        (("distance", (6,), (0.0,)), "distances 0"),
        (("distance", (6,), (float("inf"),)), "distances inf"),
    ],
)
def test_wrong_levels_are_rejected(arguments, message):
    with pytest.raises(ConfigError, match=message):
        open_difficulty(*arguments)


def test_levels_by_points_need_points():
    with pytest.raises(ConfigError, match="need the number of points"):
        evaluate([], [], difficulty=PointDifficulty())


def test_the_outcomes_take_the_level_with_the_most_objects():
    """KITTI's hard, the least points, any distance."""
    labels = [to_objects([car(), car(x=6, z=60, occluded=3)])]
    for difficulty, points, expected in (
        (KITTI, None, ["tp", "ignored"]),
        (DistanceDifficulty((30.0,)), None, ["tp", "tp"]),
        (PointDifficulty((6, 2)), [np.array([2, 1])], ["tp", "ignored"]),
    ):
        found, _ = object_outcomes(labels, labels, difficulty=difficulty, points=points)
        assert found.outcomes.tolist() == expected


def test_a_range_includes_its_lower_limit():
    """An object at exactly 30 m is in the range from 30 m."""
    at_limit = [to_objects([car(z=30.0)])]
    found = evaluate(at_limit, at_limit, difficulty=DistanceDifficulty((30.0,)))
    assert found.objects[0].tolist() == [0, 1]
