"""Simulated sequences: the motion of vehicle and objects, and the data set on disk."""

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from curate.datasets.base import pose_of, sequences_of, time_of
from curate.datasets.folder import FolderDataset
from curate.detections import CATEGORIES
from curate.errors import ConfigError, DataError
from curate.geometry.overlap import bev_iou
from curate.simulation import simulate
from curate.simulation.motion import Motion, Vehicle, World
from curate.simulation.population import Placement
from curate.simulation.scene import Scene
from curate.simulation.street import Street

TIMES = np.arange(20) / 10
SPEEDS = {"Car": 16.0, "Pedestrian": 2.2, "Cyclist": 8.0}


@cache
def world(seed: int) -> World:
    """Return a random world."""
    return World.draw(np.random.default_rng([seed, 0]), np.random.default_rng([seed, 3]), TIMES)


@cache
def placed(seed: int, step: int) -> list[Placement]:
    """Return the objects of a world in a frame."""
    return list(world(seed).scene(float(TIMES[step])).placements)


def in_map(seed: int, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Return places and headings of all objects in the frame of time 0."""
    pose = world(seed).pose(float(TIMES[step]))
    objects = placed(seed, step)
    places = np.array([each.position for each in objects]) @ pose[:3, :3].T + pose[:3, 3]
    turn = np.arctan2(pose[1, 0], pose[0, 0])
    return places, np.array([each.yaw_rad for each in objects]) + turn


SEEDS = range(6)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_sequence_begins_in_the_scene_of_a_single_frame(seed: int) -> None:
    scene = Scene.draw(np.random.default_rng([seed, 0]))
    first = world(seed).scene(0.0)
    np.testing.assert_allclose(first.vertices, scene.vertices, atol=1e-4)
    np.testing.assert_allclose(world(seed).pose(0.0), np.eye(4), atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_poses_carry_what_stands_to_the_same_place(seed: int) -> None:
    """Trees, houses and parked cars; the others move by speed times time along their heading."""
    before, yaws = in_map(seed, 0)
    for step in (7, 19):
        places, turned = in_map(seed, step)
        for i, motion in enumerate(world(seed).motions):
            shift = places[i] - before[i]
            turn = np.angle(np.exp(1j * (turned[i] - yaws[i])))
            assert turn == pytest.approx(motion.turn_rate * TIMES[step], abs=1e-9)
            if not motion.speed:
                np.testing.assert_allclose(shift, 0, atol=1e-9)
            arc = motion.turn_rate * TIMES[step] / 2
            expected = motion.speed * TIMES[step] * np.sinc(arc / np.pi)
            assert np.hypot(*shift[:2]) == pytest.approx(expected, abs=1e-9)


def test_speeds_are_plausible_and_all_categories_move() -> None:
    moving = set()
    for seed in SEEDS:
        for placement, motion in zip(world(seed).placements, world(seed).motions, strict=True):
            if placement.kind in CATEGORIES:
                assert 0 <= motion.speed <= SPEEDS[placement.kind]
                moving |= {placement.kind} if motion.speed else set()
            elif placement.kind != "shadow":
                assert motion == Motion()
    assert moving == set(CATEGORIES)
    assert len({world(seed).vehicle.speed for seed in SEEDS}) > 3


@pytest.mark.parametrize("seed", SEEDS)
def test_actors_do_not_drive_through_each_other(seed: int) -> None:
    """Their boxes, at 90 % of their size, do not overlap in any frame."""
    for step in range(0, len(TIMES), 3):
        actors = [each for each in placed(seed, step) if each.kind in CATEGORIES]
        boxes = np.array(
            [[*a.position, *(0.9 * a.mesh.size * a.scale), a.yaw_rad] for a in actors]
        ).reshape(-1, 7)
        overlap = bev_iou(boxes, boxes)
        np.fill_diagonal(overlap, 0)
        assert overlap.max(initial=0) < 1e-12


@pytest.mark.parametrize("seed", SEEDS)
def test_shadows_stay_below_their_objects(seed: int) -> None:
    objects = placed(seed, 19)
    for one, other in pairwise(objects):
        if other.kind == "shadow":
            np.testing.assert_allclose(one.position[:2], other.position[:2], atol=1e-9)


def test_the_vehicle_heads_where_it_goes() -> None:
    """The derivative of its path has the direction of its heading, whatever its speed."""
    for heading, speed in ((0.2, 12.0), (-0.1, 5.0), (0.0, 8.0)):
        vehicle = Vehicle(heading, speed)
        times = np.linspace(0, 3, 3001)
        (s, d) = np.gradient(vehicle.places(times), times, axis=0).T
        np.testing.assert_allclose(
            np.arctan2(d, s)[1:-1], -vehicle.street_headings(times)[1:-1], atol=0.01
        )
        assert np.abs(vehicle.places(times)[:, 1]).max() <= 0.8


def test_a_street_at_its_origin_is_the_same_street() -> None:
    street = Street.draw(np.random.default_rng(4))
    moved = replace(street, origin=(12.0, 0.5, 0.25))
    cos, sin = np.cos(street.heading_rad), np.sin(street.heading_rad)
    shift = [12 * cos - 0.5 * sin, 12 * sin + 0.5 * cos, 0.25]
    np.testing.assert_allclose(moved.to_lidar(30, -2), street.to_lidar(30, -2) - shift)
    np.testing.assert_allclose(moved.ground().vertices, street.ground().vertices - shift, atol=1e-4)


@pytest.fixture(scope="module")
def drives(tmp_path_factory) -> Path:
    """Return three sequences of two frames; the last one is for validation."""
    root = tmp_path_factory.mktemp("drives")
    simulate(root, 6, 2, val_frames=2, workers=1, sequences=3)
    return root


def test_the_folder_reader_reads_sequences_times_and_poses(drives: Path) -> None:
    dataset = FolderDataset(drives)
    names = tuple(f"{sequence:04d}_{number:06d}" for sequence in range(3) for number in range(2))
    assert dataset.frame_ids() == names
    assert dict(sequences_of(dataset, names)) == {name: name[:4] for name in names}
    assert dataset.splits() == {"train": names[:4], "val": names[4:], "trainval": names}
    assert [time_of(dataset, name) for name in names] == [0.0, 0.1] * 3
    np.testing.assert_allclose(pose_of(dataset, names[0]), np.eye(4), atol=1e-12)
    frame = dataset.read(names[1], image=True)
    assert 20_000 < len(frame.points) < 40_000
    assert frame.image.shape == (375, 1242, 3)
    assert (drives / "semantic_2" / f"{names[1]}.png").exists()
    one, other = (dataset.read(name, points=False).calibration for name in names[:2])
    np.testing.assert_array_equal(one.projection, other.projection)


def test_labels_of_what_stands_agree_through_the_poses(drives: Path) -> None:
    """In the map frame, standing cars have the same label in both frames, to a centimetre."""
    dataset, agreeing = FolderDataset(drives), 0
    for sequence in range(3):
        places = []
        for number in range(2):
            name = f"{sequence:04d}_{number:06d}"
            truth, pose = dataset.annotations(name), dataset.pose_of(name)
            cars = truth.boxes[truth.categories == "Car", :3]
            places.append(cars @ pose[:3, :3].T + pose[:3, 3])
        gaps = np.linalg.norm(places[0][:, None] - places[1], axis=2)
        agreeing += int((gaps.min(axis=1, initial=np.inf) < 0.03).sum())
    assert agreeing >= 5


def test_sequences_resume_and_are_not_mixed_with_single_frames(drives: Path) -> None:
    lost = [drives / "poses" / "0001_000001.txt", drives / "velodyne" / "0002_000000.bin"]
    before = [path.read_bytes() for path in lost]
    for path in lost:
        path.unlink()
    simulate(drives, 6, 2, val_frames=2, workers=1, sequences=3)
    assert [path.read_bytes() for path in lost] == before
    with pytest.raises(
        ConfigError, match=r"sequences=3 format=.*, requested .*val_frames=2 format"
    ):
        simulate(drives, 6, 2, val_frames=2, workers=1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sequences": 0}, "sequences must be 1 to 8, the number of frames, not 0"),
        ({"sequences": 9}, "sequences must be 1 to 8, the number of frames, not 9"),
        ({"sequences": 3}, "8 frames are not divisible into 3 sequences .* choose 6 frames"),
        ({"sequences": 2, "val_frames": 3}, "a multiple of the 4 frames of a sequence, not 3"),
    ],
)
def test_sequences_must_be_whole(tmp_path: Path, arguments: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        simulate(tmp_path / "data", 8, 0, workers=1, **arguments)
    assert not (tmp_path / "data").exists()


def test_a_folder_of_other_data_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "dataset.toml").write_text('points = "lidar"\n')
    with pytest.raises(DataError, match="was not simulated"):
        simulate(tmp_path, 2, 0, workers=1, sequences=1)
