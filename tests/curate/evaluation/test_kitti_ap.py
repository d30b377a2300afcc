"""KITTI average precision: the official values, a slow oracle, cases by hand, and limits."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import kitti_devkit
from support.kitti_scenes import car, random_frames, to_objects

from curate.datasets.kitti.labels import KittiObjects
from curate.errors import DataError
from curate.evaluation.kitti_ap import FIGURES, evaluate, score_thresholds
from curate.evaluation.kitti_folders import read_folders

EMPTY = KittiObjects.empty()
seeds = st.integers(0, 2**32 - 1)


def objects_of(frames):
    """Return lists of dicts as `KittiObjects`."""
    return [to_objects(frame) for frame in frames]


def with_scores(labels):
    """Return the labels as detections with score 1."""
    return [replace(frame, scores=np.ones(len(frame))) for frame in labels]


def ap_of_cars(labels, results, **options):
    """Return the evaluation's (4, 3) R40 of cars."""
    return evaluate(objects_of(labels), objects_of(results), **options).ap_r40[0]


@pytest.fixture(scope="module")
def official(kitti_eval_root):
    """Return labels, results, and the values that the official program prints for them."""
    _, labels, results = read_folders(kitti_eval_root / "label_2", kitti_eval_root / "results")
    return labels, results, json.loads((kitti_eval_root / "expected.json").read_text())


@pytest.mark.parametrize("kit_sampling", [False, True])
def test_the_official_values_are_reproduced(official, kit_sampling):
    """Every value of the devkit to 1e-4, in its own JSON shape."""
    labels, results, expected = official
    figures = evaluate(labels, results, kit_sampling=kit_sampling).as_dict()
    assert figures["thresholds"] == expected["thresholds"]
    assert figures["difficulties"] == expected["difficulties"]
    for positions in ("AP_R40", "AP_R11"):
        assert figures[positions].keys() == expected[positions].keys()
        for category, by_figure in expected[positions].items():
            assert figures[positions][category].keys() == by_figure.keys()
            for figure, values in by_figure.items():
                assert figures[positions][category][figure] == pytest.approx(values, abs=1e-4)
    assert all(min(counted) > 0 for counted in figures["objects"].values())


def test_ground_truth_against_itself_is_100(official):
    """Exactly, in every value, on all frames together and on each frame alone."""
    labels = official[0]
    for frames in [labels, *([frame] for frame in labels[:60])]:
        evaluation = evaluate(frames, with_scores(frames))
        there = np.broadcast_to(evaluation.objects[:, None, :] > 0, evaluation.ap_r40.shape)
        for averages in (evaluation.ap_r11, evaluation.ap_r40):
            assert np.all(averages[there] == 100)
            assert np.isnan(averages[~there]).all()
        assert np.all(evaluation.recall_3d[there[:, :3]] == 1)


@settings(max_examples=25)
@given(seeds)
def test_crowded_frames_equal_the_slow_oracle(seed):
    """All categories, values and difficulties of frames with copies, ties and clutter."""
    labels, results = random_frames(np.random.default_rng(seed), 8)
    evaluation = evaluate(objects_of(labels), objects_of(results), kit_sampling=True)
    for c, (category, overlap) in enumerate(evaluation.min_overlaps.items()):
        for f, figure in enumerate(FIGURES):
            for d in range(3):
                expected = kitti_devkit.average_precision(
                    labels, results, category, figure, d, overlap
                )
                got = evaluation.ap_r11[c, f, d], evaluation.ap_r40[c, f, d]
                if evaluation.objects[c, d] == 0:  # the devkit prints 0
                    assert np.isnan(got).all()
                    assert expected == (0, 0)
                else:
                    assert got == pytest.approx(expected, abs=1e-9), (category, figure, d)


def test_more_objects_than_positions_equal_the_slow_oracle():
    """With more than 41 objects both ways of sampling are the devkit's."""
    labels, results = random_frames(np.random.default_rng(11), 150)
    evaluation = evaluate(objects_of(labels), objects_of(results))
    assert evaluation.objects[0, 2] > 41
    expected = kitti_devkit.average_precision(labels, results, "Car", "3d", 2, 0.7)
    assert (evaluation.ap_r11[0, 3, 2], evaluation.ap_r40[0, 3, 2]) == pytest.approx(expected)


@settings(max_examples=20)
@given(seeds)
def test_the_order_of_frames_does_not_matter(seed):
    """AP, counts and recall are the same for shuffled frames."""
    generator = np.random.default_rng(seed)
    labels, results = map(objects_of, random_frames(generator, 10))
    order = generator.permutation(10)
    one = evaluate(labels, results)
    other = evaluate([labels[i] for i in order], [results[i] for i in order])
    assert np.allclose(one.curves, other.curves, rtol=0, atol=1e-12, equal_nan=True)
    assert np.array_equal(one.objects, other.objects)
    assert np.array_equal(one.recall_3d, other.recall_3d, equal_nan=True)


@settings(max_examples=20)
@given(seeds)
def test_a_false_positive_with_the_lowest_score_never_raises_precision(seed):
    """At any recall."""
    labels, results = random_frames(np.random.default_rng(seed), 8)
    before = evaluate(objects_of(labels), objects_of(results))
    results[3] = [*results[3], car(x=40, z=60, score=0.001, box_2d=(900, 0, 999, 99))]
    after = evaluate(objects_of(labels), objects_of(results))
    known = ~np.isnan(before.curves)
    assert np.array_equal(known, ~np.isnan(after.curves))
    assert np.all(after.curves[known] <= before.curves[known])


@settings(max_examples=20)
@given(seeds)
def test_values_are_percentages_and_orientation_is_below_image(seed):
    """Within 0 and 100, NaN only without objects, AOS at most the image AP, falling curves."""
    labels, results = random_frames(np.random.default_rng(seed), 6)
    evaluation = evaluate(objects_of(labels), objects_of(results))
    for averages in (evaluation.ap_r11, evaluation.ap_r40):
        there = np.broadcast_to(evaluation.objects[:, None] > 0, averages.shape)
        assert np.array_equal(there, ~np.isnan(averages))
        assert np.all((averages[there] >= 0) & (averages[there] <= 100))
        assert not np.any(averages[:, 1] > averages[:, 0] + 1e-9)
    assert not np.any(np.diff(evaluation.curves, axis=-1) > 0)


def test_half_of_the_objects_found_by_the_formula():
    """Two cars, the better detection correct, the other false: precision 1 up to recall 1/2."""
    labels = [[car(), car(x=6)]]
    results = [[car(score=0.9), car(x=-6, score=0.8)]]
    averages = evaluate(objects_of(labels), objects_of(results))
    assert averages.ap_r40[0, 3].tolist() == pytest.approx([100 * 20 / 40] * 3)
    assert averages.ap_r11[0, 3].tolist() == pytest.approx([100 * 6 / 11] * 3)
    assert averages.recall_3d[0, :, 0].tolist() == [0.5, 0.5, 0.5]
    kit = evaluate(objects_of(labels), objects_of(results), kit_sampling=True)
    assert kit.ap_r40[0, 3, 0] == 0  # one position, which R40 leaves out as the first
    assert kit.ap_r11[0, 3, 0] == pytest.approx(100 / 11)


def test_a_false_detection_above_a_true_one_by_the_formula():
    """Scores 0.9 true, 0.8 false, 0.7 true: precision 1 to recall 1/2, then 2/3."""
    labels = [[car(), car(x=6)]]
    results = [[car(score=0.9), car(x=-6, score=0.8), car(x=6, score=0.7)]]
    evaluation = evaluate(objects_of(labels), objects_of(results))
    assert evaluation.ap_r40[0, 3, 0] == pytest.approx(100 * (20 * 1 + 20 * 2 / 3) / 40)
    assert evaluation.ap_r11[0, 3, 0] == pytest.approx(100 * (6 * 1 + 5 * 2 / 3) / 11)


def test_orientation_by_the_formula():
    """A car with a heading error of 60 degrees counts (1 + cos 60) / 2."""
    averages = ap_of_cars([[car(alpha=0.0)]], [[car(alpha=np.pi / 3)]])
    assert averages[FIGURES.index("image"), 0] == 100
    assert averages[FIGURES.index("aos"), 0] == pytest.approx(75)


@pytest.mark.parametrize(("along_z", "found"), [(-1, 100), (1, 0)])
def test_rotation_y_turns_clockwise_seen_from_above(along_z, found):
    """The front of a car at rotation_y points to (cos, -sin) in x and z."""
    turn = 0.5
    long_car = car(rotation_y=turn, dimensions=(1.5, 1.0, 8.0), location=(0.0, 1.7, 20.0))
    nose = (3.5 * np.cos(turn), 1.7, 20 + along_z * 3.5 * np.sin(turn))
    cube = {**long_car, "dimensions": (1.5, 1.0, 1.0), "location": nose}
    averages = ap_of_cars([[long_car]], [[cube]], min_overlaps={"Car": 0.12})
    assert averages[FIGURES.index("bev"), 0] == averages[FIGURES.index("3d"), 0] == found


@pytest.mark.parametrize(
    ("change", "counted"),
    [
        ({}, [1, 1, 1]),
        ({"occluded": 1}, [0, 1, 1]),
        ({"occluded": 2}, [0, 0, 1]),
        ({"occluded": 3}, [0, 0, 0]),
        ({"truncated": 0.15}, [1, 1, 1]),
        ({"truncated": 0.3}, [0, 1, 1]),
        ({"truncated": 0.5}, [0, 0, 1]),
        ({"truncated": 0.51}, [0, 0, 0]),
        ({"box_2d": (100, 100, 180, 140)}, [0, 1, 1]),
        ({"box_2d": (100, 100, 180, 140.1)}, [1, 1, 1]),
        ({"box_2d": (100, 100, 180, 125)}, [0, 0, 0]),
        ({"category": "Van"}, [0, 0, 0]),
    ],
)
def test_difficulty_decides_what_counts(change, counted):
    """Occlusion, truncation and height set the difficulty; harder objects are not missed."""
    evaluation = evaluate(objects_of([[car(**change)]]), [EMPTY])
    assert evaluation.objects[0].tolist() == counted
    found = [0 if count else None for count in counted]
    assert evaluation.as_dict()["AP_R40"]["Car"] == dict.fromkeys(FIGURES, found)


@pytest.mark.parametrize("change", [{"category": "Van"}, {"occluded": 3}, {"truncated": 0.9}])
def test_detecting_an_ignored_object_is_not_a_false_positive(change):
    """A detection on a van or an occluded car does not change the AP."""
    labels = [[car(), car(x=6, **change)]]
    results = [[car(score=0.5), car(x=6, score=0.9)]]
    assert ap_of_cars(labels, results)[0].tolist() == [100, 100, 100]
    apart = ap_of_cars([[car()]], results)
    assert apart[0].tolist() == [50, 50, 50]


def test_detections_in_dont_care_regions_are_ignored_only_in_the_image():
    """By the share of the detection's 2D box; the region has no 3D box."""
    region = car(
        x=6,
        category="DontCare",
        dimensions=(-1, -1, -1),
        location=(-1000, -1000, -1000),
        box_2d=(380, 80, 1000, 300),
    )
    results = [[car(score=0.5), car(x=6, score=0.9)]]
    averages = ap_of_cars([[car(), region]], results)
    assert averages[FIGURES.index("image"), 0] == 100
    assert averages[FIGURES.index("3d"), 0] == 50


def test_small_detections_are_ignored():
    """A detection below 25 pixels is never a false positive; at 30 it is, except for easy."""
    low = car(x=6, score=0.95, box_2d=(400, 100, 480, 124))
    assert ap_of_cars([[car()]], [[car(), low]])[3].tolist() == [100, 100, 100]
    middle = {**low, "box_2d": (400, 100, 480, 130)}
    assert ap_of_cars([[car()]], [[car(), middle]])[3].tolist() == [100, 50, 50]


def test_a_small_detection_of_another_category_can_match_an_object():
    """As in the devkit: the height is checked before the category, and the higher score matches."""
    low = car(category="Pedestrian", score=0.9, box_2d=(400, 100, 480, 120))
    found = [[car(score=0.5), low]]
    assert ap_of_cars([[car()]], found)[3].tolist() == [0, 0, 0]
    assert ap_of_cars([[car()]], [[car(score=0.5), {**low, "score": 0.4}]])[3, 0] == 100


def test_a_second_detection_of_the_same_object_is_false():
    assert ap_of_cars([[car()]], [[car(score=0.9), car(score=0.9)]])[3, 0] == 50


def test_detections_with_equal_scores_are_counted_together():
    """With one score for all, precision is the same at every recall."""
    labels = [[car()] for _ in range(60)]
    results = [[car(score=0.5), car(x=6, score=0.5)] for _ in range(60)]
    curve = evaluate(objects_of(labels), objects_of(results)).curves[0, 3, 0]
    assert curve.tolist() == [0.5] * 41


def test_without_objects_there_is_no_figure():
    """No frames or no objects: nothing to compute. Objects without detections: 0."""
    one = objects_of([[car()]])
    for labels, results in (([], []), ([EMPTY], [EMPTY]), ([EMPTY], one)):
        evaluation = evaluate(labels, results)
        assert np.isnan(evaluation.curves).all()
        assert np.isnan(evaluation.recall_3d).all()
        assert evaluation.objects.sum() == 0
        plain = json.loads(json.dumps(evaluation.as_dict(), allow_nan=False))
        assert plain["AP_R40"]["Car"]["3d"] == plain["recall_3d"]["Car"]["0.7"] == [None] * 3
    missed = evaluate(one, [EMPTY])
    assert np.all(missed.ap_r40[0] == 0)
    assert np.all(missed.recall_3d[0] == 0)
    assert missed.objects.tolist() == [[1, 1, 1], [0, 0, 0], [0, 0, 0]]


def test_without_orientation_there_is_no_aos():
    """One detection without an observation angle (-10): null, as the devkit prints none."""
    results = [[car(), car(x=6, alpha=-10.0)]]
    evaluation = evaluate(objects_of([[car()]]), objects_of(results))
    figures = evaluation.as_dict()["AP_R40"]["Car"]
    assert figures["aos"] is None
    assert figures["image"] == [50.0, 50.0, 50.0]


def test_chosen_categories_and_overlaps_are_used():
    shifted = [[car(x=0.8)]]
    strict = evaluate(objects_of([[car()]]), objects_of(shifted))
    loose = evaluate(objects_of([[car()]]), objects_of(shifted), min_overlaps={"Car": 0.3})
    assert (strict.ap_r40[0, 3, 0], loose.ap_r40[0, 3, 0]) == (0, 100)
    assert list(loose.as_dict()["AP_R40"]) == ["Car"]
    assert strict.as_dict()["recall_3d"]["Car"] == {
        "0.3": [100.0] * 3,
        "0.5": [100.0] * 3,
        "0.7": [0.0] * 3,
    }


def test_results_without_scores_or_frames_are_rejected():
    """In one line."""
    labels = objects_of([[car()]])
    with pytest.raises(DataError, match="results of frame 0, object 1: no score"):
        evaluate(labels, objects_of([[car(), car(score=np.nan)]]))
    with pytest.raises(DataError, match="1 frames of labels"):
        evaluate(labels, [])


def test_thresholds_step_through_recall():
    """With 41 objects or more, all found, there are 41 thresholds; with fewer, one each."""
    for count in (41, 42, 79, 80, 100, 1234):
        assert len(score_thresholds(np.arange(count) / count, count)) == 41
    assert score_thresholds(np.array([0.1, 0.7, 0.4]), 3).tolist() == [0.7, 0.4, 0.1]
    assert score_thresholds(np.zeros(0), 0).tolist() == []
