"""The data of the benchmarks: sweeps, boxes and KITTI frames, drawn from a given generator."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from support.kitti_scenes import random_frames, to_objects

from curate.datasets.kitti.labels import KittiObjects, read_objects
from curate.detections import CATEGORIES, Annotations, Detections, as_categories

SIDES = np.array([[4.0, 1.7, 1.5], [0.8, 0.6, 1.75], [1.8, 0.6, 1.7]])
"""(3, 3) usual length, width and height of `CATEGORIES`, in metres."""


def sweep(generator: np.random.Generator, count: int) -> np.ndarray:
    """Return (count, 4) float32 points around the sensor, denser near it as in a real sweep."""
    distance = np.minimum(3 + generator.exponential(14, count), 80)
    azimuth = generator.uniform(-np.pi, np.pi, count)
    x, y = distance * np.cos(azimuth), distance * np.sin(azimuth)
    z = -1.7 + generator.exponential(0.5, count)
    return np.column_stack([x, y, z, generator.random(count)]).astype(np.float32)


def scattered_boxes(generator: np.random.Generator, count: int, reach: float) -> np.ndarray:
    """Return (count, 7) boxes of three categories, their centres at most `reach` metres away."""
    sides = SIDES[generator.integers(len(SIDES), size=count)]
    centres = generator.uniform([-reach, -reach, -1.2], [reach, reach, -0.6], (count, 3))
    sides = sides * generator.uniform(0.85, 1.15, (count, 3))
    return np.column_stack([centres, sides, generator.uniform(-np.pi, np.pi, count)])


def clustered_boxes(generator: np.random.Generator, objects: int, each: int) -> np.ndarray:
    """Return (objects * each, 7) boxes as a detector predicts them before NMS."""
    guesses = np.repeat(scattered_boxes(generator, objects, 60), each, axis=0)
    spread = np.array([0.3, 0.3, 0.1, 0.15, 0.08, 0.08, 0.15])
    guesses += generator.normal(0, 1, guesses.shape) * spread
    guesses[:, 3:6] = np.maximum(guesses[:, 3:6], 0.2)
    return guesses


def guesses_around(
    generator: np.random.Generator, annotations: Annotations, clutter: int
) -> Detections:
    """Return detections: every object with a small offset, and false positives."""
    wanted = annotations.select(np.isin(annotations.categories, CATEGORIES))
    kinds = generator.integers(len(CATEGORIES), size=clutter)
    nowhere = generator.uniform([5, -25, -1.2], [60, 25, -0.6], (clutter, 3))
    boxes = np.column_stack([nowhere, SIDES[kinds], generator.uniform(-np.pi, np.pi, clutter)])
    boxes = np.concatenate([wanted.boxes, boxes])
    boxes[:, :3] += generator.normal(0, 0.05, (len(boxes), 3))
    names = [*wanted.categories.tolist(), *np.asarray(CATEGORIES)[kinds].tolist()]
    return Detections(boxes, generator.uniform(0.1, 1, len(boxes)), as_categories(names))


def kitti_frames(
    generator: np.random.Generator, count: int, examples: Path | None
) -> tuple[list[KittiObjects], list[KittiObjects]]:
    """Return labels and results of many frames: the examples repeated with small differences.

    Args:
        generator: draws the differences.
        count: number of frames.
        examples: a folder with label_2/ and results/; None draws frames instead.
    """
    if examples is None:
        labels, results = (list(map(to_objects, side)) for side in random_frames(generator, 250))
        labels = [replace(each, scores=np.full(len(each), np.nan)) for each in labels]
    else:
        names = sorted(path.name for path in (examples / "label_2").glob("*.txt"))
        labels = [read_objects(examples / "label_2" / name) for name in names]
        results = [read_objects(examples / "results" / name, scored=True) for name in names]
    return (
        [labels[i % len(labels)] for i in range(count)],
        [_otherwise(generator, results[i % len(results)]) for i in range(count)],
    )


def _otherwise(generator: np.random.Generator, results: KittiObjects) -> KittiObjects:
    """Return the same results with other scores and slightly other positions."""
    count = len(results)
    return replace(
        results,
        boxes_2d=results.boxes_2d + np.tile(generator.normal(0, 1, (count, 2)), 2),
        locations=results.locations + generator.normal(0, 0.02, (count, 3)),
        scores=np.clip(results.scores + generator.normal(0, 0.05, count), 0, 1),
    )
