"""Synthetic KITTI frames: dicts for the slow oracle, `KittiObjects` for the tested code."""

import numpy as np

from curate.datasets.kitti.labels import KittiObjects
from curate.detections import as_categories

LABELLED = ("Car", "Car", "Van", "Pedestrian", "Person_sitting", "Cyclist", "Misc", "DontCare")


def car(x=0.0, z=20.0, **changes):
    """Return one easy car as a dict; `changes` replace its values."""
    item = {
        "category": "Car",
        "truncated": 0.0,
        "occluded": 0,
        "alpha": 0.5,
        "box_2d": (100.0 + 50 * x, 100.0, 180.0 + 50 * x, 160.0),
        "dimensions": (1.5, 1.6, 4.0),
        "location": (float(x), 1.7, float(z)),
        "rotation_y": 0.3,
        "score": 0.9,
    }
    return {**item, **changes}


def to_objects(items):
    """Return the dicts of one frame as `KittiObjects`."""

    def column(name, width, dtype=np.float64):
        values = np.array([item[name] for item in items], dtype=dtype)
        return values.reshape(-1, width) if width else values.reshape(-1)

    return KittiObjects(
        as_categories([item["category"] for item in items]),
        column("truncated", 0),
        column("occluded", 0, np.int64),
        column("alpha", 0),
        column("box_2d", 4),
        column("dimensions", 3),
        column("location", 3),
        column("rotation_y", 0),
        column("score", 0),
    )


def random_frames(generator, count):
    """Return labels and results per frame: crowded, with ties, copies and clutter."""
    labels = [random_labels(generator) for _ in range(count)]
    return labels, [random_results(generator, frame) for frame in labels]


def random_labels(generator):
    """Return up to seven objects: some occluded, truncated, too small, or DontCare regions."""
    items = []
    for category in generator.choice(LABELLED, generator.integers(8)):
        left, top = generator.uniform(0, 300, 2).round(1)
        item = car(
            *generator.uniform([-4, 8], [4, 16]).round(1),
            category=str(category),
            truncated=float(generator.choice([0, 0.1, 0.2, 0.4, 0.6])),
            occluded=int(generator.integers(4)),
            alpha=float(generator.uniform(-3, 3)),
            box_2d=(left, top, left + 60, top + float(generator.choice([20, 25, 30, 40, 41, 80]))),
            rotation_y=float(generator.uniform(-3, 3)),
        )
        if category == "DontCare":
            item |= {"dimensions": (-1, -1, -1), "location": (-1000, -1000, -1000)}
        items.append(item)
    return items


def random_results(generator, labels):
    """Return copies and near copies of the labels, some doubled or renamed, and false positives."""
    seen = [item for item in labels if item["category"] != "DontCare"]
    nowhere = [item for item in random_labels(generator)[:2] if item["category"] != "DontCare"]
    items = []
    for item in [*seen, *nowhere, *seen[: generator.integers(3)]]:
        if generator.random() < 0.2:
            continue
        spread = float(generator.choice([0, 0.03, 0.3]))
        shift = generator.normal(0, spread, 3)
        box_2d = np.array(item["box_2d"]) + 8 * np.tile(shift[:2], 2)
        near = {"Van": "Car", "Person_sitting": "Pedestrian", "Misc": "Car"}
        items.append(
            {
                **item,
                "category": near.get(item["category"], item["category"]),
                "alpha": item["alpha"] + float(generator.normal(0, 0.3)),
                "box_2d": tuple(box_2d.tolist()),
                "location": tuple((np.array(item["location"]) + shift).tolist()),
                "score": float(generator.choice([0.1, 0.3, 0.5, 0.5, generator.random()])),
            }
        )
    return items
