"""Confidence bands, and the memory of the previous round."""

import numpy as np
import pytest

from curate.detections import as_categories
from curate.errors import ConfigError, DataError
from curate.weighting.base import Age, Evidence, Memory
from curate.weighting.st3d import ST3D

KEEP, IGNORE, DROP = "keep", "ignore", "drop"


def car(x, frame=0, category="Car"):
    """Return frame, category and box of a label 4 m long at x."""
    return frame, category, [x, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]


def common(places, scores, ious=None):
    """Return the columns that evidence and memory share."""
    frames, categories, boxes = zip(*places, strict=True) if places else ((), (), ())
    return {
        "frame_index": np.array(frames, dtype=np.int64),
        "category": as_categories(categories),
        "score": np.array(scores, dtype=np.float64),
        "iou": np.full(len(places), np.nan) if ious is None else np.array(ious),
        "boxes": np.array(boxes, dtype=np.float64).reshape(-1, 7),
    }


def bands(places, scores, past=None, policy=None, ious=None):
    """Return the band of each label; `past` is (positions, scores) of the previous round."""
    memory = None if past is None else Memory(**common(*past), v=np.ones(len(past[0])))
    labels = Evidence(
        **common(places, scores, ious), loss=np.full(len(places), np.nan), memory=memory
    )
    weights = (policy or ST3D()).weigh(labels, Age(2, 3))
    assert set(weights.v.tolist()) <= {0.0, 1.0}
    assert not weights.v[weights.dropped].any()
    return [
        DROP if dropped else (KEEP if v else IGNORE)
        for v, dropped in zip(weights.v, weights.dropped, strict=True)
    ]


def test_without_a_memory_the_score_decides():
    """From 0.6 on a label is kept, from 0.25 on ignored, else dropped."""
    places = [car(10.0 * i) for i in range(4)]
    assert bands(places, [0.6, 0.59, 0.25, 0.24]) == [KEEP, IGNORE, IGNORE, DROP]


def test_a_remembered_object_with_a_better_score_raises_the_band():
    """Cars moved by half a metre overlap enough; a worse remembered score changes nothing."""
    places = [car(0), car(20), car(40), car(60)]
    past = ([car(0.5), car(20.5), car(40.5)], [0.9, 0.3, 0.3])
    assert bands(places, [0.1, 0.1, 0.7, 0.1], past) == [KEEP, IGNORE, KEEP, DROP]


@pytest.mark.parametrize(
    "other", [car(0, frame=1), car(0, category="Van"), car(3.8), car(50)], ids=str
)
def test_other_remembered_objects_do_not_count(other):
    """Another frame, another category, an overlap below 0.1, or another position."""
    assert bands([car(0)], [0.1], ([other], [0.9])) == [DROP]


def test_one_remembered_object_raises_one_label():
    """The one that overlaps it most."""
    places = [car(0), car(1.0)]
    assert bands(places, [0.1, 0.1], ([car(0.9)], [0.9])) == [DROP, KEEP]
    assert bands(places, [0.1, 0.1], ([car(0.1)], [0.9])) == [KEEP, DROP]


def test_of_two_remembered_objects_the_nearer_counts():
    """Not the one with the higher score."""
    past = ([car(0.1), car(1.5)], [0.3, 0.9])
    assert bands([car(0)], [0.1], past) == [IGNORE]


def test_an_empty_memory_equals_no_memory():
    """The policy kept nothing in the previous round."""
    assert bands([car(0)], [0.7], ([], [])) == [KEEP]
    assert bands([], [], ([car(0)], [0.7])) == []


def test_the_confidence_can_be_the_estimated_iou():
    """As in the paper; a detector without estimates is rejected."""
    policy = ST3D(keep=0.5, ignore=0.2, confidence="iou")
    assert bands([car(0), car(20)], [0.0, 0.9], policy=policy, ious=[0.5, 0.1]) == [KEEP, DROP]
    with pytest.raises(ConfigError, match="st3d: the detector does not estimate the IoU"):
        bands([car(0)], [0.9], policy=policy)


def test_a_memory_without_current_boxes_is_an_error():
    """It cannot be matched."""
    memory = Memory(**common([car(0)], [0.9]), v=np.ones(1))
    with pytest.raises(DataError, match="without the boxes of the labels"):
        Evidence(np.zeros(1, int), as_categories(["Car"]), np.ones(1), np.ones(1), memory=memory)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"keep": 0.2}, "ascending"),
        ({"keep": 1.2}, "1.2"),
        ({"confidence": "luck"}, "luck"),
        ({"minimum_iou": 0.0}, "minimum_iou"),
    ],
)
def test_invalid_settings_are_rejected(wrong, message):
    """The error contains the policy and the setting."""
    with pytest.raises(ConfigError, match=f"st3d.*{message}"):
        ST3D(**wrong)
