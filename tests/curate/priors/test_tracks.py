"""Track evidence: figures of each label's track, by hand, and what the tracks depend on."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from curate.detections import CATEGORIES, Detections
from curate.errors import ConfigError, DataError
from curate.priors.base import Evidence, SequenceFrame, check_evidence
from curate.priors.tracks import Tracks
from curate.simulation.motion import World

CAR, PEDESTRIAN = (4.0, 1.8, 1.6), (0.8, 0.6, 1.7)


def labels(*rows: tuple[float, ...], category: str = "Car", size=CAR) -> Detections:
    """Return labels from rows of x, y and score."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    boxes = np.column_stack(
        [table[:, :2], np.zeros(len(table)), np.tile(size, (len(table), 1)), np.zeros(len(table))]
    )
    return Detections(boxes, table[:, 2], np.full(len(table), category))


def joined(*parts: Detections) -> Detections:
    """Return the labels of several parts."""
    return Detections(
        np.concatenate([part.boxes for part in parts]),
        np.concatenate([part.scores for part in parts]),
        np.concatenate([part.categories for part in parts]),
    )


def unread() -> None:
    """Fail the test: track evidence needs no sensor data."""
    raise AssertionError("the frame was read")


def frame(number: int | str, found: Detections, time_s=None, pose=None) -> SequenceFrame:
    """Return a frame of a sequence."""
    name = number if isinstance(number, str) else f"0001_{number:06d}"
    return SequenceFrame(name, found, unread, time_s, pose)


def column(evidence: Sequence[Evidence], name: str) -> list[float]:
    """Return a column over all frames."""
    return [float(value) for each in evidence for value in each[name]]


def log_odds(score: float) -> float:
    return float(np.log(score / (1 - score)))


def test_figures_by_hand() -> None:
    """A parked car in frames 0, 1, 3 of 0 to 4 with one longer box, and clutter in frame 3."""
    scores = {0: 0.5, 1: 0.8, 3: 0.9}
    frames = [frame(i, labels((10, 0, scores[i])) if i in scores else labels()) for i in range(5)]
    frames[3] = frame(3, labels((10, 0, 0.9), (30, 9, 0.2)))
    frames[1].detections.boxes[0, 3] = 8.0
    found = Tracks().score_sequence(frames)
    mean = np.mean([log_odds(score) for score in scores.values()])
    assert [len(each["track_length"]) for each in found] == [1, 1, 0, 2, 0]
    assert column(found, "track_length") == [3, 3, 3, 1]
    assert column(found, "track_score") == pytest.approx([*[mean] * 3, log_odds(0.2)])
    assert column(found, "track_max_score") == pytest.approx([*[log_odds(0.9)] * 3, log_odds(0.2)])
    assert column(found, "track_hits") == [2, 2, 2, 0]
    assert column(found, "track_misses") == [2, 2, 2, 4]
    third = np.log(2) / 3  # the logarithm of the mean length is ln 4 + ln 2 / 3
    assert column(found, "track_size_deviation") == pytest.approx([third, 2 * third, third, 0])


def test_hits_and_misses_are_within_a_second() -> None:
    """25 frames at 10 Hz: 10 on either side, fewer at the ends."""
    found = Tracks().score_sequence([frame(i, labels((10, 0, 0.5))) for i in range(25)])
    hits = column(found, "track_hits")
    assert (hits[0], hits[5], hits[12], hits[24]) == (10, 15, 20, 10)
    assert set(column(found, "track_misses")) == {0.0}


def test_scores_of_0_and_1_are_finite() -> None:
    found = Tracks().score_sequence([frame(0, labels((10, 0, 0.0), (30, 0, 1.0)))])
    assert column(found, "track_score") == pytest.approx([log_odds(1e-4), log_odds(1 - 1e-4)])


def test_categories_have_tracks_of_their_own() -> None:
    """A car and a pedestrian at the same place."""
    both = joined(labels((10, 0, 0.5)), labels((10, 0, 0.6), category="Walker", size=PEDESTRIAN))
    found = Tracks().score_sequence([frame(0, both), frame(1, labels((10, 0, 0.5)))])
    assert column(found, "track_length") == [2, 1, 2]


def queue(count: int, speed: float, poses: bool, time_step: float = 0.1) -> list[SequenceFrame]:
    """Return frames of a queue of parked pedestrians, seen from a vehicle that turns and drives.

    Per frame, the vehicle moves by about the distance of two pedestrians: without poses, each one
    seems to stand where the next one stood. Their scores alternate between 0.2 and 0.8.
    """
    places = np.column_stack([np.arange(2.0, 40.0), np.full(38, 3.0)])
    frames = []
    for i in range(count):
        time, turn = i * time_step, 0.3 * i * time_step
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        seen = (places - [speed * time, 0]) @ rotation
        pose = np.eye(4)
        pose[:2, :2], pose[0, 3] = rotation, speed * time
        rows = [(*place, (0.2, 0.8)[k % 2]) for k, place in enumerate(seen)]
        found = labels(*rows, category="Pedestrian", size=PEDESTRIAN)
        frames.append(frame(i, found, pose=pose if poses else None))
    return frames


def test_ego_motion_is_taken_out_by_the_poses() -> None:
    """With poses each pedestrian has a track of its own; without them, it joins its neighbours."""
    found = Tracks().score_sequence(queue(10, speed=10.0, poses=True))
    assert column(found, "track_length") == [10.0] * 380
    own = [log_odds(0.2), log_odds(0.8)] * 190
    assert column(found, "track_score") == pytest.approx(own)
    found = Tracks().score_sequence(queue(10, speed=10.0, poses=False))
    mixed = np.abs(np.subtract(column(found, "track_score"), own)) > 0.1
    assert mixed.mean() > 0.9


def test_a_frame_of_a_map_does_not_change_the_tracks() -> None:
    """Poses in another map frame, 500 km away and turned, give the same evidence."""
    frames = queue(8, speed=7.0, poses=True)
    far = np.array([[0.0, -1, 0, 5e5], [1, 0, 0, -4e5], [0, 0, 1, 120], [0, 0, 0, 1]])
    moved = [frame(each.frame_id, each.detections, pose=far @ each.pose) for each in frames]
    for one, other in zip(
        Tracks().score_sequence(frames), Tracks().score_sequence(moved), strict=True
    ):
        for name, values in one.items():
            np.testing.assert_array_equal(values, other[name], err_msg=name)


def driving(numbers: Sequence[int | str], place: Callable[[int], float]) -> list[SequenceFrame]:
    """Return frames with one car at a place on the x axis that depends on the index."""
    return [frame(name, labels((place(i), 0, 0.5))) for i, name in enumerate(numbers)]


def test_missing_frames_are_a_longer_time_step() -> None:
    """A car at 20 m/s in frames 0, 1, 2, 7, 8: the prediction over 0.5 s fits by the number."""
    numbers = [0, 1, 2, 7, 8]
    found = Tracks().score_sequence(driving(numbers, lambda i: 2.0 * numbers[i]))
    assert column(found, "track_length") == [5.0] * 5
    assert column(found, "track_misses") == [0.0] * 5


def test_frames_are_sorted_by_time_not_by_name() -> None:
    """clip_9 comes before clip_10; with timestamps, names of any kind do."""
    names = ["clip_10", "clip_11", "clip_8", "clip_9"]
    places = {name: 10.0 * int(name[5:]) for name in names}
    found = Tracks(rate_hz=2.0).score_sequence(
        [frame(name, labels((places[name] / 2, 0, 0.5))) for name in names]
    )
    assert column(found, "track_length") == [4.0] * 4
    tokens = {"b7": 0.5, "0c": 0.0, "ff": 1.0, "a1": 1.5}
    found = Tracks().score_sequence(
        [
            frame(name, labels((10 * time, 0, 0.5)), time_s=1.5e9 + time)
            for name, time in tokens.items()
        ]
    )
    assert column(found, "track_length") == [4.0] * 4


def test_the_rate_is_the_time_between_two_numbers() -> None:
    """At 0.5 Hz two frames are two seconds apart, which is longer than a track can be lost."""
    frames = driving([0, 1], lambda _i: 10.0)
    assert column(Tracks(rate_hz=1.0).score_sequence(frames), "track_length") == [2, 2]
    assert column(Tracks(rate_hz=0.5).score_sequence(frames), "track_length") == [1, 1]


@pytest.mark.parametrize("count", [0, 1])
def test_short_sequences(count: int) -> None:
    """No frame, or one frame, whose name needs no number."""
    found = Tracks().score_sequence([frame("night", labels((10, 0, 0.5)))][:count])
    assert column(found, "track_length") == [1.0] * count
    assert column(found, "track_misses") == [0.0] * count


def test_a_sequence_without_labels() -> None:
    found = Tracks().score_sequence([frame(i, Detections.empty()) for i in range(3)])
    for each in found:
        assert all(len(values) == 0 for values in check_evidence(Tracks(), each, 0).values())


def test_an_unknown_time_is_an_error() -> None:
    frames = driving(["clip_a", "clip_b"], lambda _i: 10.0)
    with pytest.raises(DataError, match=r"frame clip_a: .* does not end with the number"):
        Tracks().score_sequence(frames)
    with pytest.raises(DataError, match="frame clip_a"):
        Tracks().check_frame("clip_a", None)
    Tracks().check_frame("clip_a", 0.5)
    Tracks().check_frame("clip_7", None)


def test_poses_of_some_frames_only_are_an_error() -> None:
    frames = queue(3, speed=1.0, poses=True)
    frames[1] = queue(3, speed=1.0, poses=False)[1]
    with pytest.raises(DataError, match="frame 0001_000001: no pose, but other frames"):
        Tracks().score_sequence(frames)


@pytest.mark.parametrize("rate", [0.0, -1.0, np.nan, np.inf])
def test_an_impossible_rate_is_rejected(rate: float) -> None:
    with pytest.raises(ConfigError, match="rate_hz must be above 0"):
        Tracks(rate_hz=rate)


def test_a_description_names_every_figure() -> None:
    row = {name.name: f"<{name.name}>" for name in Tracks.columns}
    text = Tracks().describe(row)
    assert all(value in text for value in row.values())


def simulated_labels(seed: int, poses: bool) -> tuple[list[SequenceFrame], np.ndarray]:
    """Return a simulated drive of 3 s with noisy labels, and the true object of each label.

    One in ten objects is missed in a frame; a third of the labels is clutter of low score (object
    -1, each at a random place).
    """
    rng, times = np.random.default_rng(seed), np.arange(30) / 10
    world = World.draw(np.random.default_rng([seed, 0]), np.random.default_rng([seed, 3]), times)
    frames, objects = [], []
    for number, time in enumerate(times):
        rows, names = [], []
        for i, each in enumerate(world.scene(float(time)).placements):
            if each.kind in CATEGORIES and rng.random() < 0.9:
                place = each.position[:2] + rng.normal(0, 0.12, size=2)
                rows.append((*place, 0, *(each.mesh.size * each.scale), each.yaw_rad, 0.7))
                names.append(each.kind)
                objects.append(i)
        for _ in range(len(rows) // 2):
            kind = rng.choice(CATEGORIES)
            size = CAR if kind == "Car" else PEDESTRIAN
            rows.append((*rng.uniform((5, -25), (70, 25)), 0, *size, 0, 0.2))
            names.append(kind)
            objects.append(-1)
        table = np.array(rows).reshape(-1, 8)
        found = Detections(table[:, :7], table[:, 7], np.array(names, dtype=np.str_))
        frames.append(frame(number, found, pose=world.pose(float(time)) if poses else None))
    return frames, np.array(objects)


def test_tracks_of_a_simulated_drive_follow_its_objects() -> None:
    """With poses, tracks are nearly as long as the objects were seen, and clutter stays short."""
    lengths: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(2):
        for poses, shares in lengths.items():
            frames, objects = simulated_labels(seed, poses)
            length = np.array(column(Tracks().score_sequence(frames), "track_length"))
            is_object = objects >= 0
            seen = np.bincount(objects[is_object])[objects[is_object]]
            shares.append(float(np.mean(length[is_object] / seen)))
            if poses:
                assert np.mean(length[~is_object]) < 5
    assert 0.93 < np.mean(lengths[True]) < 1.07
    assert abs(np.mean(lengths[True]) - 1) < abs(np.mean(lengths[False]) - 1)
