"""Per-object outcomes against the counts of the evaluation and handmade frames."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.kitti_devkit import Frame
from support.kitti_scenes import car, random_frames, to_objects

from curate.datasets.kitti.labels import KittiObjects
from curate.errors import ConfigError
from curate.evaluation.kitti_ap import evaluate
from curate.evaluation.kitti_outcomes import object_outcomes


def outcomes_of(labels, results, **options):
    """Return the outcomes of lists of lists of dicts."""
    return object_outcomes(
        [to_objects(frame) for frame in labels], [to_objects(frame) for frame in results], **options
    )


def test_each_object_has_its_outcome():
    """Found, missed with a near miss, too hard, found twice, and a false positive."""
    labels = [[], [car(), car(x=6), car(x=12, occluded=3), car(x=18, category="Van")]]
    results = [
        [car(score=0.4)],
        [car(score=0.8), car(score=0.7), car(x=7, score=0.6), car(x=18, score=0.5)],
    ]
    of_labels, of_results = outcomes_of(labels, results)
    assert of_labels.frames.tolist() == [1, 1, 1, 1]
    assert of_labels.indices.tolist() == [0, 1, 2, 3]
    assert of_labels.outcomes.tolist() == ["tp", "fn", "ignored", "ignored"]
    assert of_labels.matches.tolist() == [0, -1, -1, 3]
    assert of_labels.overlaps[0] == 1
    assert 0.2 < of_labels.overlaps[1] < 0.7
    assert of_labels.scores[0] == 0.8
    assert np.isnan(of_labels.scores[1])
    assert of_results.frames.tolist() == [0, 1, 1, 1, 1]
    assert of_results.indices.tolist() == [0, 0, 1, 2, 3]
    assert of_results.outcomes.tolist() == ["fp", "tp", "fp", "fp", "ignored"]
    assert of_results.matches.tolist() == [-1, 0, -1, -1, 3]
    assert of_results.scores.tolist() == [0.4, 0.8, 0.7, 0.6, 0.5]
    assert set(of_results.categories) == {"Car"}


def test_an_object_found_only_by_a_small_detection_is_ignored():
    """It is neither found nor missed, and refers to the detection."""
    low = car(box_2d=(100, 100, 180, 120))
    of_labels, of_results = outcomes_of([[car()]], [[low]])
    assert of_labels.outcomes.tolist() == of_results.outcomes.tolist() == ["ignored"]
    assert of_labels.matches.tolist() == of_results.matches.tolist() == [0]


def test_detections_in_dont_care_regions_are_ignored_only_in_the_image():
    """A match there stays a true positive; in 3D the region is unknown."""
    region = car(
        category="DontCare",
        dimensions=(-1, -1, -1),
        location=(-1000, -1000, -1000),
        box_2d=(0, 0, 1000, 300),
    )
    frames = [[car(), region]], [[car(), car(x=6)]]
    assert outcomes_of(*frames, metric="image")[1].outcomes.tolist() == ["tp", "ignored"]
    assert outcomes_of(*frames, metric="3d")[1].outcomes.tolist() == ["tp", "fp"]


def test_detections_below_the_score_threshold_are_not_used():
    """They have no row and no overlap."""
    of_labels, of_results = outcomes_of([[car()]], [[car(score=0.2)]], score_threshold=0.3)
    assert of_labels.outcomes.tolist() == ["fn"]
    assert of_labels.overlaps.tolist() == [0]
    assert len(of_results) == 0


@settings(max_examples=25)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from(["image", "bev", "3d"]),
    st.integers(0, 2),
    st.sampled_from([0.0, 0.3, 0.5]),
)
def test_outcomes_add_up_to_the_counts_of_the_oracle(seed, metric, difficulty, threshold):
    """True and false positives at a score threshold, and misses, per category."""
    labels, results = random_frames(np.random.default_rng(seed), 6)
    of_labels, of_results = outcomes_of(
        labels,
        results,
        metric=metric,
        level=("easy", "moderate", "hard")[difficulty],
        score_threshold=threshold,
    )
    for category, overlap in {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}.items():
        frames = [
            Frame(label, result, category, metric, difficulty, overlap)
            for label, result in zip(labels, results, strict=True)
        ]
        hits, false, _ = np.sum([frame.tally(threshold) for frame in frames], axis=0)
        found = of_labels.outcomes[of_labels.categories == category].tolist()
        matched = of_results.outcomes[of_results.categories == category].tolist()
        assert found.count("tp") == matched.count("tp") == hits
        assert matched.count("fp") == false
        assert len(found) == sum(state != "absent" for frame in frames for state in frame.states)


def test_matches_refer_to_each_other():
    """A found object's detection refers to that object, and both have the same overlap."""
    labels, results = random_frames(np.random.default_rng(2), 30)
    of_labels, of_results = outcomes_of(labels, results, metric="bev")
    matched = {
        (frame, index): row
        for row, (frame, index) in enumerate(
            zip(of_results.frames, of_results.indices, strict=True)
        )
        if of_results.outcomes[row] == "tp"
    }
    found = np.flatnonzero(of_labels.outcomes == "tp")
    assert len(found) == len(matched) > 10
    for row in found:
        other = matched[of_labels.frames[row], of_labels.matches[row]]
        assert of_results.matches[other] == of_labels.indices[row]
        assert of_results.overlaps[other] == of_labels.overlaps[row]
        assert of_results.scores[other] == of_labels.scores[row]


def test_misses_agree_with_the_recall():
    """Without a score threshold, tp / (tp + fn) is the recall if none is ignored."""
    labels = [[car(), car(x=6)], [car()]]
    results = [[car()], [car(score=0.01)]]
    of_labels, _ = outcomes_of(labels, results)
    recall = evaluate(
        [to_objects(frame) for frame in labels], [to_objects(frame) for frame in results]
    ).recall_3d[0, 2, 2]
    assert np.mean(of_labels.outcomes == "tp") == recall == pytest.approx(2 / 3)


def test_no_frames_and_no_objects_have_no_outcomes():
    for frames in ([], [KittiObjects.empty()]):
        of_labels, of_results = object_outcomes(frames, frames)
        assert len(of_labels) == len(of_results) == 0


@pytest.mark.parametrize("wrong", [{"metric": "4d"}, {"level": "harder"}])
def test_unknown_names_are_rejected(wrong):
    """The message lists the known ones."""
    with pytest.raises(ConfigError, match="image, bev, 3d"):
        outcomes_of([], [], **wrong)
