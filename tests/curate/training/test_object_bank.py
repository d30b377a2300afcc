"""Cut-and-paste augmentation: the object bank, and the frame after a paste."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from curate.errors import LeakageError
from curate.geometry.overlap import bev_iou
from curate.geometry.points_in_boxes import box_of_points, count_points_in_boxes
from curate.training.augmentation import Augmentation
from curate.training.labels import Sample
from curate.training.object_bank import ObjectBank, paste_objects


def wall(distance, half_width=30.0):
    """Return points of a wall across the view, from the ground to 2 m above the sensor."""
    y, z = np.meshgrid(np.arange(-half_width, half_width, 0.1), np.arange(-1.7, 2, 0.1))
    points = np.stack([np.full(y.size, distance), y.ravel(), z.ravel(), np.zeros(y.size)], axis=1)
    inside_view = np.abs(points[:, 1]) < 0.8 * points[:, 0]
    return points[inside_view].astype(np.float32)


def sample_of(points, boxes=(), name="000000", **changes):
    """Return a labeled sample of cars with weight 1."""
    boxes = np.array(boxes, dtype=float).reshape(-1, 7)
    n = len(boxes)
    base = Sample(name, True, points, boxes, np.array(["Car"] * n, dtype=np.str_), np.ones(n))
    return replace(base, **changes)


# A small margin for points on a side.
GROWTH = np.array([0, 0, 0, 0.01, 0.01, 0.01, 0])
CAR = [15.0, 3.0, -0.9, 4.0, 1.6, 1.5, 0.4]


def car_points(count=60, seed=0):
    """Return points inside CAR."""
    rng = np.random.default_rng(seed)
    local = rng.uniform(-0.49, 0.49, (count, 3)) * CAR[3:6]
    cos, sin = np.cos(CAR[6]), np.sin(CAR[6])
    local[:, :2] = local[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    return np.column_stack([local + CAR[:3], np.full(count, 0.9)]).astype(np.float32)


@pytest.fixture
def bank():
    """Return a bank with one car of 60 points."""
    return ObjectBank.build([sample_of(car_points(), [CAR])], ("Car", "Tram"))


def test_the_bank_contains_objects_with_their_points(bank):
    """Box and points of each object are cut out unchanged."""
    (car,) = bank.objects["Car"]
    assert car.box.tolist() == CAR
    assert len(car.points) == 60
    assert bank.objects["Tram"] == ()


def test_objects_with_few_points_or_weight_zero_are_left_out():
    """Barely visible or uncertain objects are not examples."""
    few = sample_of(car_points(4), [CAR])
    ignored = sample_of(car_points(), [CAR], weights=np.zeros(1))
    assert ObjectBank.build([few, ignored], ("Car",), 5).objects["Car"] == ()


def test_an_unlabeled_frame_in_the_bank_is_a_leak():
    """Pseudo-labels never become examples; the error contains the frame."""
    with pytest.raises(LeakageError, match="000077"):
        ObjectBank.build([sample_of(car_points(), [CAR], "000077", labeled=False)], ("Car",))


def paste(sample, bank, count=3, seeds=range(12)):
    """Return the results of several pastes that added something."""
    results = [paste_objects(sample, bank, count, np.random.default_rng(seed)) for seed in seeds]
    return [result for result in results if len(result.boxes) > len(sample.boxes)]


def test_a_pasted_object_keeps_its_points_and_its_distance(bank):
    """It has weight 1 and all its points, at the same distance from the sensor."""
    results = paste(sample_of(wall(40)), bank)
    assert results
    for result in results:
        assert result.categories.tolist() == ["Car"]
        assert result.weights.tolist() == [1.0]
        box = result.boxes[0]
        assert np.hypot(*box[:2]) == pytest.approx(np.hypot(*CAR[:2]))
        assert box[2:6].tolist() == pytest.approx(CAR[2:6])
        grown = box + GROWTH
        assert count_points_in_boxes(result.points, grown[None])[0] == 60


def test_a_pasted_object_hides_points_behind_it(bank):
    """The wall has a hole in the object's shadow and is unchanged beside it."""
    scene = wall(40)
    for result in paste(sample_of(scene), bank):
        box = result.boxes[0]
        left = result.points[result.points[:, 3] == 0]
        azimuth = np.arctan2(left[:, 1], left[:, 0]) - np.arctan2(box[1], box[0])
        slope = left[:, 2] / np.hypot(left[:, 0], left[:, 1])
        top, bottom = (box[2] + s * box[5] / 2 for s in (0.9, -0.9))
        distance = np.hypot(box[0], box[1])
        in_shadow = (
            (np.abs(azimuth) < 0.02) & (slope < top / distance) & (slope > bottom / distance)
        )
        assert not in_shadow.any()
        gone = len(scene) - len(left)
        assert 0 < gone < len(scene) / 2


def test_nothing_is_pasted_behind_a_wall(bank):
    """The sensor could not see that position."""
    assert paste(sample_of(wall(8)), bank) == []


def test_nothing_is_pasted_onto_a_box_or_onto_another_pasted_object(bank):
    """Boxes do not overlap afterwards, whatever their weights."""
    standing = [[15.0, y, -0.9, 4.0, 1.6, 1.5, 0.0] for y in (-6.0, 0.0, 6.0)]
    sample = sample_of(wall(40), standing, weights=np.array([1.0, 0.2, 0.0]))
    many = ObjectBank({"Car": bank.objects["Car"] * 6})
    results = paste(sample, many)
    assert results
    for result in results:
        overlap = bev_iou(result.boxes, result.boxes)
        np.fill_diagonal(overlap, 0)
        assert overlap.max() == 0


def test_nothing_is_pasted_onto_unlabeled_obstacles(bank):
    """Dense posts without a box leave no free position; low stumps do."""
    x, y = np.meshgrid(np.arange(5, 40, 0.7), np.arange(-30, 30, 0.7))
    for top, possible in ((CAR[2], False), (CAR[2] - CAR[5] / 2 + 0.2, True)):
        posts = np.stack([x, y, np.full(x.shape, top), np.zeros(x.shape)], axis=-1)
        ground = posts.copy()
        ground[..., 2] = CAR[2] - CAR[5] / 2
        points = np.concatenate([posts, ground]).reshape(-1, 4).astype(np.float32)
        seen = points[np.abs(points[:, 1]) < 0.8 * points[:, 0]]
        assert bool(paste(sample_of(seen), bank)) is possible


@st.composite
def streets(draw):
    """Draw a narrow view of bare ground, some posts, and boxes of any weight."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    bottom = CAR[2] - CAR[5] / 2
    ground = np.column_stack([rng.uniform(4, 45, 3000), rng.uniform(-12, 12, 3000)])
    feet = np.column_stack([rng.uniform(6, 45, 12), rng.uniform(-10, 10, 12)])
    posts = np.repeat(feet, 15, axis=0)
    heights = np.concatenate([np.full(3000, bottom), bottom + rng.uniform(0, 3, len(posts))])
    places = np.concatenate([ground, posts])
    points = np.column_stack([places, heights, np.zeros(len(places))]).astype(np.float32)
    count = draw(st.integers(0, 6))
    standing = np.column_stack([
        rng.uniform(8, 40, count), rng.uniform(-10, 10, count), np.full(count, CAR[2]),
        np.tile(CAR[3:6], (count, 1)), rng.uniform(-3, 3, count),
    ])  # fmt: skip
    weights = rng.choice([0.0, 0.4, 1.0], count)
    seen = np.abs(points[:, 1]) < 0.4 * points[:, 0]
    return sample_of(points[seen], standing, weights=weights), int(rng.integers(2**32))


def bank_of_three():
    """Return a near car, a far one and a farther one, so that one can hide another."""
    samples = []
    for distance in (9.0, 18.0, 27.0):
        box, points = list(CAR), car_points(120)
        box[0] += distance - CAR[0]
        points[:, 0] += distance - CAR[0]
        samples.append(sample_of(points, [box]))
    return ObjectBank.build(samples, ("Car",))


@settings(max_examples=60)
@given(streets())
def test_the_invariants_of_a_paste(street):
    """No overlap with any box, only ground at the position, nothing visible through an object."""
    sample, seed = street
    result = paste_objects(sample, bank_of_three(), 3, np.random.default_rng(seed))
    old, new = result.boxes[: len(sample.boxes)], result.boxes[len(sample.boxes) :]
    np.testing.assert_array_equal(old, sample.boxes)
    assert result.weights[len(old) :].tolist() == [1.0] * len(new)
    if not len(new):
        return
    assert not bev_iou(new, old).any()
    assert not bev_iou(new, new)[~np.eye(len(new), dtype=bool)].any()
    above_ground = new + np.array([0, 0, 0.15, 0, 0, -0.3, 0])
    assert not count_points_in_boxes(sample.points, above_ground).any()
    azimuth, distance = (
        of(result.points[:, 1], result.points[:, 0]) for of in (np.arctan2, np.hypot)
    )
    slope = result.points[:, 2] / distance
    owner = box_of_points(result.points, new + GROWTH)
    for k in range(len(new)):
        own = (owner == k) & (result.points[:, 3] > 0)
        if own.sum() < 10:
            continue  # itself hidden by another
        sides = [np.percentile(of[own], (5, 95)) for of in (azimuth, slope)]
        through = distance > distance[own].max() + 0.1
        for of, (low, high) in zip((azimuth, slope), sides, strict=True):
            through &= (of > low) & (of < high)
        assert not through.any()


def test_one_pasted_object_hides_another():
    """In a view just wide enough for one car, some paste puts one hidden behind another."""
    ground = wall(60, half_width=60.0)
    narrow = ground[np.abs(ground[:, 1]) < 0.3 * ground[:, 0]]
    hidden = 0
    for result in paste(sample_of(narrow), bank_of_three(), seeds=range(40)):
        seen = count_points_in_boxes(result.points, result.boxes + GROWTH)
        hidden += int((seen < 60).sum())
    assert hidden > 0


def test_nothing_is_pasted_onto_a_label_of_weight_zero(bank):
    """Even if it counts as background and is not a target."""
    standing = [[15.0, y, -0.9, 4.0, 4.0, 1.5, 0.0] for y in np.arange(-9, 10, 4.5)]
    sample = sample_of(wall(40), standing, labeled=False, weights=np.zeros(5))
    for zero, boxes in (("ignore", 5), ("background", 0)):
        sample = replace(sample, zero_weight=zero)
        augmentation = Augmentation(0.0, 0.0, (1.0, 1.0), 3, 0)
        for seed in range(8):
            changed = augmentation.apply(sample, bank, np.random.default_rng(seed))
            pasted = changed.boxes[boxes:]
            assert len(changed.boxes) == boxes + len(pasted)
            assert changed.weights.tolist() == [0.0] * boxes + [1.0] * len(pasted)
            assert not bev_iou(pasted, np.array(standing)).any()


def test_a_pasted_object_stands_on_the_ground(bank):
    """On ground half a metre higher the object is lifted with its points."""
    x, y = np.meshgrid(np.arange(5, 40, 0.5), np.arange(-30, 30, 0.5))
    bottom = CAR[2] - CAR[5] / 2
    field = np.stack([x, y, np.full(x.shape, bottom + 0.5), np.zeros(x.shape)], axis=-1)
    points = field.reshape(-1, 4).astype(np.float32)
    results = paste(sample_of(points[np.abs(points[:, 1]) < 0.8 * points[:, 0]]), bank)
    assert results
    for result in results:
        assert result.boxes[0, 2] == pytest.approx(CAR[2] + 0.5, abs=1e-5)
        assert count_points_in_boxes(result.points[-60:], result.boxes + GROWTH)[0] == 60


def test_nothing_is_pasted_onto_a_roof(bank):
    """If the lowest points are metres above the ground, the position is not used."""
    roof = wall(40)
    roof[:, 0] = np.random.default_rng(0).uniform(8, 40, len(roof))
    roof[:, 2] = 3.0
    assert paste(sample_of(roof), bank) == []


def test_pasting_stays_in_view(bank):
    """An object that would extend beyond the view is not placed."""
    for result in paste(sample_of(wall(40, half_width=8.0)), bank, seeds=range(40)):
        assert np.abs(result.points[:, 1] / result.points[:, 0]).max() < 8.1 / 40


def test_pasting_is_reproducible_and_does_not_change_the_sample(bank):
    sample = sample_of(wall(40))
    before = sample.points.copy()
    first, second = (paste_objects(sample, bank, 2, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(sample.points, before)


def test_without_points_nothing_is_pasted(bank):
    """An empty frame, or a count of 0, is returned unchanged."""
    empty = sample_of(np.zeros((0, 4), dtype=np.float32))
    assert paste_objects(empty, bank, 3, np.random.default_rng(0)) is empty
    full = sample_of(wall(40))
    assert len(paste_objects(full, bank, 0, np.random.default_rng(0)).boxes) == 0


def test_augmentation_moves_points_and_boxes_together(bank):
    """Every object has its points inside its box afterwards."""
    augmentation = Augmentation(0.5, np.pi / 4, (0.9, 1.1), pasted=2, fewest_points=5)
    sample = sample_of(np.concatenate([wall(40), car_points()]), [CAR])
    for seed in range(10):
        changed = augmentation.apply(sample, bank, np.random.default_rng(seed))
        grown = changed.boxes + GROWTH
        assert (count_points_in_boxes(changed.points, grown) >= 60).all()
        assert (changed.weights == 1).all()


def test_objects_with_too_few_points_are_ignored(bank):
    """They are neither targets nor background."""
    augmentation = Augmentation(0.0, 0.0, (1.0, 1.0), pasted=0, fewest_points=5)
    sample = sample_of(np.concatenate([wall(40), car_points(4)]), [CAR])
    assert augmentation.apply(sample, bank, np.random.default_rng(0)).weights.tolist() == [0.0]
