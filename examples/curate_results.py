"""Curate your own detector's results: KITTI result files in, weighted labels out.

python curate_results.py                  # simulates frames and results first
python curate_results.py KITTI RESULTS    # your frames, and a folder of FRAME.txt
"""

# %% Frames and results
# KITTI holds training/velodyne, image_2, calib, and label_2 for the labeled frames. RESULTS holds a
# text file per frame with 16 fields per line, the last the score: what KITTI's benchmark takes.
import subprocess
import sys
from pathlib import Path

import numpy as np

from curate import (
    Annotations,
    Detections,
    KittiDataset,
    from_detections,
    read_labels,
    write_objects,
)


def curate(*arguments: object) -> None:
    """Run a curate command, as a shell would."""
    subprocess.run(["curate", *map(str, arguments)], check=True)


def stand_in(truth: Annotations, generator: np.random.Generator) -> Detections:
    """Return what a mediocre detector might find: true boxes, shifted, and as many false ones."""
    boxes = np.concatenate([truth.boxes, truth.boxes + np.eye(7)[1] * 6])
    boxes[:, :3] += generator.normal(0, 0.15, (len(boxes), 3))
    found = np.repeat([0.75, 0.35], len(truth))
    scores = np.clip(generator.normal(found, 0.15), 0.05, 0.95)
    return Detections(boxes, scores, np.tile(truth.categories, 2))


if len(sys.argv) == 3:
    data, results = Path(sys.argv[1]), Path(sys.argv[2])
else:
    data, results = Path("simulated"), Path("results")
    curate("simulate", data, "--frames", 12, "--seed", 1)
    results.mkdir(exist_ok=True)
    frames = KittiDataset(data)
    for number, name in enumerate(frames.frame_ids()):
        frame = frames.read(name, points=False)
        found = stand_in(frames.annotations(name), np.random.default_rng(number))
        objects = from_detections(found, frame.calibration, frame.image_size)
        write_objects(results / f"{name}.txt", objects)

# %% A workspace
# A quarter of the frames keeps its ground truth: it teaches how many points a real object has. The
# results come without augmented copies, so labels are weighed by the priors alone.
work = Path("work")
if not work.exists():
    curate(
        "init", work, "--root", data, "--labeled", 0.25,
        "--detector", "recorded", "--detector-path", results,
        "--segmenter", "simulated" if data.name == "simulated" else "none",
        "--set", "solve.self_paced=false",
    )  # fmt: skip

# %% Weights
# Every label gets its evidence (LiDAR points inside, segmentation agreement) and a weight.
curate("run", "--workspace", work)
labels = work / "exports" / "labels.sqlite"

# %% The labels
# Now explore them (explore_labels.py) or train on them (train_your_own.py).
table = read_labels(labels)
print(f"{len(table)} labels in {labels}")
print(table[["frame", "k", "category", "score", "points", "rho_det", "weight"]].head(10))
