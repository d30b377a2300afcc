"""Headings of detections against those of the ground truth."""

import numpy as np
import pytest

from curate.detections import Annotations, Detections, as_categories
from curate.evaluation.heading_examination import examine_headings

COUNT = 24


def street(seed=0, spread=0.15):
    """Return ground truth along a street: cars in both directions, some turned a little."""
    rng = np.random.default_rng(seed)
    boxes = np.zeros((COUNT, 7))
    boxes[:, 0], boxes[:, 1] = np.arange(COUNT) * 6.0, rng.choice([-4.0, 4.0], COUNT)
    boxes[:, 3:6] = 4.0, 1.7, 1.5
    boxes[:, 6] = np.where(boxes[:, 1] > 0, np.pi, 0) + rng.normal(0, spread, COUNT)
    zeros = np.zeros(COUNT)
    return Annotations(
        boxes, as_categories(["Car"] * COUNT), zeros, zeros.astype(np.int64), zeros,
        np.zeros((COUNT, 4)),
    )  # fmt: skip


def found(truth, change, noise=0.03):
    """Return detections near the objects with a changed yaw, and one false positive."""
    rng = np.random.default_rng(1)
    boxes = np.vstack([truth.boxes, truth.boxes[:1] + np.eye(7)[0] * 500])
    boxes[:, :2] += rng.normal(0, 0.1, (len(boxes), 2))
    boxes[:, 6] = change(boxes[:, 6]) + rng.normal(0, noise, len(boxes))
    return Detections(boxes, np.full(len(boxes), 0.5), as_categories(["Car"] * len(boxes)))


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda yaw: yaw + np.pi, "yaw + pi (the front is the rear)"),
        (lambda yaw: -yaw, "-yaw (it grows clockwise)"),
        (lambda yaw: np.pi - yaw, "pi - yaw"),
        (lambda yaw: yaw - np.pi / 2, "yaw + pi/2"),
        (lambda yaw: yaw + np.pi / 2, "yaw - pi/2"),
        (lambda yaw: -yaw - np.pi / 2, "-yaw - pi/2 (it is KITTI's rotation_y)"),
    ],
)
def test_a_wrong_convention_is_named(change, name):
    """Also those that points cannot show, such as exchanged front and rear."""
    truth = street()
    [finding] = examine_headings([(found(truth, change), truth)])
    assert (finding.check, finding.state) == ("headings", "wrong")
    assert finding.message.endswith(f"if their yaw is {name}")
    assert finding.message.startswith(f"{COUNT} boxes differ")


@pytest.mark.parametrize(
    "change",
    [
        lambda yaw: yaw,
        lambda yaw: yaw + 2 * np.pi,
        lambda yaw: yaw + np.random.default_rng(2).choice([0, np.pi], len(yaw)),
        lambda yaw: np.random.default_rng(2).uniform(-np.pi, np.pi, len(yaw)),
    ],
)
def test_correct_and_uncertain_headings_pass(change):
    """Full turns, a detector that does not know the front, and one that knows nothing."""
    truth = street()
    for noise in (0.0, 0.3):
        [finding] = examine_headings([(found(truth, change, noise), truth)])
        assert finding.state == "ok", finding.message


def test_few_pairs_decide_nothing():
    """No frames, no objects, other categories."""
    truth = street()
    detections = found(truth, lambda yaw: yaw + np.pi)
    assert examine_headings([]) == []
    assert examine_headings([(detections, truth.select(np.arange(9)))]) == []
    assert examine_headings([(detections, truth.select(np.arange(0)))]) == []
    vans = as_categories(["Van"] * len(detections))
    others = Detections(detections.boxes, detections.scores, vans)
    assert examine_headings([(others, truth)]) == []
