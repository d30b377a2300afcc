"""The degraded ground truth follows its error model, reproducibly."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from curate.errors import ConfigError, DataError
from curate.frames import Calibration, Frame
from curate.segmenters.degraded import DegradedSegmenter, ErrorModel, degrade

NO_ERRORS = ErrorModel(
    missed_instance=0,
    missed_small_instance=0,
    confused=0,
    boundary_px=0,
    patches=0,
    blobs=0,
)


@pytest.fixture
def truth():
    """Return a map with two cars, a pedestrian and a small cyclist."""
    class_ids = np.zeros((120, 300), dtype=np.uint8)
    class_ids[40:80, 20:90] = 1
    class_ids[40:80, 120:180] = 1
    class_ids[30:90, 200:220] = 2
    class_ids[50:60, 260:270] = 3
    return class_ids


@pytest.fixture
def folder(tmp_path, truth):
    """Return the ground truth of frames 000000 and 000001 as in semantic_2."""
    for name in ("000000", "000001"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), truth)
    return tmp_path


def frame(name="000000"):
    """Return a frame without points or image."""
    return Frame(
        name, np.zeros((0, 4), np.float32), Calibration(np.eye(3, 4), np.eye(4)), (300, 120)
    )


def generators(count=40):
    """Return independent generators."""
    return [np.random.default_rng([1, number]) for number in range(count)]


def test_without_errors_it_is_the_ground_truth(truth):
    """All rates at zero change nothing."""
    np.testing.assert_array_equal(degrade(truth, NO_ERRORS, np.random.default_rng(0)), truth)


def test_missed_instances_vanish_completely(truth):
    """Large regions have their own rate, small ones another."""
    all_large = replace(NO_ERRORS, missed_instance=1.0)
    degraded = degrade(truth, all_large, np.random.default_rng(0))
    assert set(np.unique(degraded)) == {0, 3}
    some = replace(NO_ERRORS, missed_instance=0.3)
    kept = [np.mean(degrade(truth, some, one)[60, 30] == 1) for one in generators(300)]
    assert 0.6 < np.mean(kept) < 0.8


def test_confused_instances_become_another_class(truth):
    """Pedestrians and cyclists are exchanged; a car becomes one of them."""
    degraded = degrade(truth, replace(NO_ERRORS, confused=1.0), np.random.default_rng(0))
    assert set(np.unique(degraded[truth == 2])) == {3}
    assert set(np.unique(degraded[truth == 3])) == {2}
    assert set(np.unique(degraded[truth == 1])) <= {2, 3}
    assert (degraded[truth == 0] == 0).all()


def test_outlines_move_by_at_most_the_limit(truth):
    """All differences are within the limit of an edge, and both directions occur."""
    errors = replace(NO_ERRORS, boundary_px=3)
    areas = []
    for generator in generators():
        degraded = degrade(truth, errors, generator)
        near_edge = cv2.dilate((truth > 0).astype(np.uint8), np.ones((7, 7))) - cv2.erode(
            (truth > 0).astype(np.uint8), np.ones((7, 7))
        )
        assert (near_edge[degraded != truth] > 0).all()
        areas.append(np.count_nonzero(degraded == 2))
    assert min(areas) < np.count_nonzero(truth == 2) < max(areas)


def test_patches_only_erase_and_blobs_only_add(truth):
    """Patches turn object pixels into background; blobs turn pixels into classes."""
    patched = degrade(truth, replace(NO_ERRORS, patches=6.0), np.random.default_rng(0))
    changed = patched != truth
    assert changed.any()
    assert (patched[changed] == 0).all()
    blotted = degrade(truth, replace(NO_ERRORS, blobs=6.0), np.random.default_rng(0))
    changed = blotted != truth
    assert changed.any()
    assert (blotted[changed] > 0).all()


def test_errors_depend_only_on_seed_and_frame(folder):
    """The order of the frames does not matter; another seed or frame has other errors."""
    first = DegradedSegmenter(folder, seed=7)
    here, there = (first.segment(frame(name)).class_ids for name in ("000000", "000001"))
    again = DegradedSegmenter(folder, seed=7)
    np.testing.assert_array_equal(again.segment(frame("000001")).class_ids, there)
    np.testing.assert_array_equal(again.segment(frame("000000")).class_ids, here)
    other = DegradedSegmenter(folder, seed=8).segment(frame("000000")).class_ids
    assert (here != there).any()
    assert (here != other).any()


def test_the_default_has_moderate_errors(folder, truth):
    """It needs no image, and most pixels do not change."""
    segmenter = DegradedSegmenter(folder)
    predicted = segmenter.segment(frame())
    assert not segmenter.needs_image
    assert predicted.category_classes["Cyclist"] == (3,)
    assert 0.8 < (predicted.class_ids == truth).mean() < 1


@pytest.mark.parametrize(
    "rates",
    [{"confused": 1.5}, {"blobs": -1}, {"patch_px": 2.5}, {"missed": 0.1}, {"blobs": "many"}],
)
def test_impossible_rates_are_rejected(folder, rates):
    """The one-line error contains the option."""
    with pytest.raises(ConfigError, match=next(iter(rates))) as caught:
        DegradedSegmenter(folder, **rates)
    assert "\n" not in str(caught.value)


def test_a_frame_without_ground_truth_is_reported(folder):
    """The error contains the missing file."""
    with pytest.raises(DataError, match="000009"):
        DegradedSegmenter(folder).segment(frame("000009"))
