"""Measure the proposals from masks and points on simulated frames of which no object is labeled.

    PYTHONPATH=tests:. .venv/bin/python tests/benchmarks/measure_proposals.py FOLDER

It takes about half a minute for the default 40 frames.
"""

import argparse
from pathlib import Path

import numpy as np

from curate.datasets.kitti.dataset import KittiDataset
from curate.detections import CATEGORIES, empty_boxes
from curate.evaluation.proposals import mean_sizes, propose_objects
from curate.geometry.overlap import bev_iou
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.simulation import simulate
from pipelines.assembly import open_segmenter
from pipelines.workspace.config import make_config

FEWEST_POINTS = 20


def main() -> None:
    """Print a row per category."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=40)
    options = parser.parse_args()
    simulate(options.folder, options.frames, 7, val_frames=1, workers=1)
    document = {
        "dataset": {"root": options.folder},
        "segmenter": {"name": "simulated", "cache": options.folder / "maps"},
    }
    config = make_config(document, "measure_proposals")
    segmenter, dataset = open_segmenter(config), KittiDataset(options.folder)
    truth = {name: dataset.annotations(name) for name in dataset.frame_ids()}
    sizes = mean_sizes(list(truth.values()), CATEGORIES)
    rows = []
    objects = dict.fromkeys(CATEGORIES, 0)
    reached = dict.fromkeys(CATEGORIES, 0)
    for name, annotations in truth.items():
        frame = dataset.read(name, image=True)
        found = propose_objects(frame, segmenter, empty_boxes(), sizes)
        known = annotations.select(np.isin(annotations.categories, CATEGORIES))
        overlap = bev_iou(found.boxes, known.boxes)
        points = count_points_in_boxes(frame.points, known.boxes)
        for i in range(len(found)):
            same = known.categories == found.categories[i]
            rows.append(
                (
                    found.categories[i],
                    overlap[i].max(initial=0) > 0.1,
                    np.where(same, overlap[i], 0).max(initial=0) > 0.5,
                )
            )
        for j in np.flatnonzero(points >= FEWEST_POINTS):
            objects[str(known.categories[j])] += 1
            reached[str(known.categories[j])] += bool((overlap[:, j] > 0.1).any())
    lines = ["| category | proposals | on an object | BEV IoU > 0.5 | objects reached |"]
    lines.append("|---|---|---|---|---|")
    for category in CATEGORIES:
        own = [row for row in rows if row[0] == category]
        on, good = (sum(row[place] for row in own) / max(len(own), 1) for place in (1, 2))
        lines.append(
            f"| {category} | {len(own)} | {on:.0%} | {good:.0%} | "
            f"{reached[category]} of {objects[category]} |"
        )
    print("\n".join(lines))  # noqa: T201


if __name__ == "__main__":
    main()
