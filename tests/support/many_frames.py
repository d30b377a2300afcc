"""A dataset of any number of recorded frames; every frame is a link to one of a few."""

import os
from pathlib import Path

import cv2
import numpy as np

from support.toys import INTENSITIES, SIZES, write_toy_kitti

TEMPLATES = 8
HEADER = "frame,view,flip_y,rotation_rad,scale,category,score,x,y,z,length,width,height,yaw"
LABELED = 8


def write_many_frames(root: Path, frames: int) -> Path:
    """Write tiny frames in KITTI's layout and recorded detections; return the path of the CSV."""
    write_toy_kitti(root, frames=TEMPLATES)
    home = root / "training"
    for path in (home / "image_2").glob("*.png"):
        cv2.imwrite(str(path), np.zeros((4, 12, 3), dtype=np.uint8))
    for i in range(TEMPLATES, frames):
        for folder, suffix in (("velodyne", "bin"), ("image_2", "png"), ("calib", "txt")):
            template = home / folder / f"{i % TEMPLATES:06d}.{suffix}"
            os.link(template, template.with_stem(f"{i:06d}"))
    names = [f"{i:06d}" for i in range(frames)]
    (root / "ImageSets" / "train.txt").write_text("\n".join(names) + "\n")
    (root / "ImageSets" / "val.txt").write_text("")
    (root / "labeled.txt").write_text("\n".join(names[:LABELED]) + "\n")
    detections = [_detections(home / "velodyne" / f"{i:06d}.bin") for i in range(TEMPLATES)]
    with (root / "detections.csv").open("w") as file:
        file.write(HEADER + "\n")
        for i, name in enumerate(names):
            file.writelines(f"{name},{line}\n" for line in detections[i % TEMPLATES])
    return root / "detections.csv"


def _detections(path: Path) -> list[str]:
    """Return a box per object, for the frame and for a mirrored copy."""
    points = np.fromfile(path, dtype=np.float32).reshape(-1, 4)
    rows = []
    for view, sign in ((0, 1), (1, -1)):
        for category, intensity in INTENSITIES.items():
            x, y, z = points[np.abs(points[:, 3] - intensity) < 0.01, :3].mean(axis=0)
            size = ",".join(map(str, SIZES[category]))
            rows.append(f"{view},{view},0,1,{category},0.8,{x:.3f},{sign * y:.3f},{z:.3f},{size},0")
    return rows
