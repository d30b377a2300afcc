"""Any number of frames with recorded detections and saved maps, on the disk of a few hundred."""

import os
from pathlib import Path

import cv2
import numpy as np

from curate.datasets.kitti.calibration import write_calibration
from curate.datasets.kitti.labels import from_annotations, write_objects
from curate.detections import CATEGORIES, Annotations, as_categories
from curate.frames import Calibration
from support.many_frames import HEADER

POINTS, BOXES, LABELED = 20_000, 30, 4
IMAGE_SIZE = (1242, 375)
SIDES = np.array([(4.0, 1.8, 1.6), (0.8, 0.6, 1.7), (1.8, 0.6, 1.7)])
CLASSES = {"Car": (1,), "Pedestrian": (2,), "Cyclist": (3,)}


def write_recorded_scenes(root: Path, frames: int, templates: int) -> dict:
    """Write frames that are links to a few, and return the settings of a workspace on them.

    Args:
        root: an absent folder.
        frames: number of frames.
        templates: number of different point clouds.
    """
    home, maps = root / "training", root / "maps"
    for folder in (*(home / name for name in ("velodyne", "image_2", "calib", "label_2")), maps):
        folder.mkdir(parents=True)
    drawn = [_template(home, maps, f"{i:06d}", np.random.default_rng(i)) for i in range(templates)]
    linked = [
        (home / "velodyne", "bin"), (home / "image_2", "png"), (home / "calib", "txt"),
        (maps, "png"),
    ]  # fmt: skip
    for i in range(templates, frames):
        for folder, suffix in linked:
            os.link(folder / f"{i % templates:06d}.{suffix}", folder / f"{i:06d}.{suffix}")
    names = [f"{i:06d}" for i in range(frames)]
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "train.txt").write_text("\n".join(names) + "\n")
    (root / "labeled.txt").write_text("\n".join(names[:LABELED]) + "\n")
    with (root / "detections.csv").open("w") as file:
        file.write(HEADER + "\n")
        for i, name in enumerate(names):
            file.writelines(f"{name},{line}\n" for line in drawn[i % templates])
    return {
        "dataset": {"root": root},
        "detector": {"name": "recorded", "path": root / "detections.csv"},
        "segmenter": {
            "name": "saved",
            "path": maps,
            "options": {"classes": {name: list(ids) for name, ids in CLASSES.items()}},
        },
    }


def _template(home: Path, maps: Path, name: str, rng: np.random.Generator) -> list[str]:
    """Write a frame; return its recorded boxes, of the frame and of a mirrored copy."""
    kinds = np.arange(BOXES) % len(CATEGORIES)
    places = rng.uniform([6, -12, -1.2], [50, 12, -0.6], (BOXES, 3))
    boxes = np.column_stack([places, SIDES[kinds], rng.uniform(-3, 3, BOXES)])
    ground = rng.uniform([2, -30, -1.8, 0], [60, 30, 1.5, 1], (POINTS // 2, 4))
    near = np.repeat(boxes, POINTS // 2 // BOXES + 1, axis=0)[: POINTS - len(ground), :3]
    objects = np.column_stack([near + rng.normal(0, 0.5, near.shape), np.ones(len(near))])
    cloud = np.concatenate([ground, objects]).astype(np.float32)
    cloud.tofile(home / "velodyne" / f"{name}.bin")
    cv2.imwrite(str(home / "image_2" / f"{name}.png"), np.zeros((*IMAGE_SIZE[::-1], 3), np.uint8))
    blocks = rng.integers(0, 4, (IMAGE_SIZE[1] // 25, IMAGE_SIZE[0] // 54), dtype=np.uint8)
    classes = np.kron(blocks, np.ones((25, 54), np.uint8))
    cv2.imwrite(str(maps / f"{name}.png"), classes)
    projection = np.array([[721.5, 0, 609.6, 44.9], [0, 721.5, 172.9, 0.2], [0, 0, 1, 0.003]])
    to_camera = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.1], [1, 0, 0, -0.3], [0, 0, 0, 1]])
    calibration = Calibration(projection, to_camera)
    write_calibration(home / "calib" / f"{name}.txt", calibration)
    if int(name) < LABELED:
        nothing = np.zeros(BOXES)
        truth = Annotations(
            boxes, as_categories([CATEGORIES[kind] for kind in kinds]), nothing,
            nothing.astype(np.int64), nothing, np.tile([0.0, 0, 100, 39], (BOXES, 1)),
        )  # fmt: skip
        write_objects(home / "label_2" / f"{name}.txt", from_annotations(truth, calibration))
    scores = np.linspace(0.9, 0.15, BOXES)
    moved = boxes + rng.normal(0, 0.05, boxes.shape)
    moved[:, [1, 6]] *= -1
    return [
        f"{view},{view},0,1,{CATEGORIES[kind]},{score:.4f},{','.join(f'{n:.4f}' for n in box)}"
        for view, rows in ((0, boxes), (1, moved))
        for kind, score, box in zip(kinds, scores, rows, strict=True)
    ]
