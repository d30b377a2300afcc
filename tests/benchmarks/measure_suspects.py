"""Plant errors in simulated labels, and measure how many of them `curate suspects` finds.

5 % of the labels each are deleted, moved by 1 to 3 m, or get another name. Then the labels are
checked by fold teachers. Printed are the precision of the first 25, 50 and 100 suspects, and the
share of the planted errors among all of them, by kind of error.

    PYTHONPATH=tests:. .venv/bin/python tests/benchmarks/measure_suspects.py FOLDER

A run resumes in the same folder. The defaults take about five minutes on one core.
"""

import argparse
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from support.silent import Silent

from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.labels import from_annotations, write_objects
from curate.detections import CATEGORIES, Annotations
from curate.geometry.overlap import bev_iou
from curate.simulation import simulate
from pipelines.assessment.suspects import FoundSuspects, SuspectRequest, run_suspects
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

SHARE = 0.05
RANKS = (25, 50, 100)


@dataclass(frozen=True)
class Planted:
    """An error: its frame, its kind, and the true box."""

    frame: str
    kind: str
    box: np.ndarray


def plant(truth: Annotations, frame: str, generator: np.random.Generator) -> tuple:
    """Return labels with errors, the boxes that each error changed, and the errors."""
    draws = generator.random(len(truth))
    kinds = np.select(
        [draws < SHARE, draws < 2 * SHARE, draws < 3 * SHARE], ["missing", "moved", "misnamed"], ""
    )
    kinds[~np.isin(truth.categories, CATEGORIES)] = ""
    boxes, names = truth.boxes.copy(), truth.categories.astype("U20")
    for i in np.flatnonzero(kinds == "moved"):
        angle, metres = generator.uniform(0, 2 * np.pi), generator.uniform(1, 3)
        boxes[i, :2] += metres * np.array([np.cos(angle), np.sin(angle)])
    for i in np.flatnonzero(kinds == "misnamed"):
        names[i] = generator.choice([name for name in CATEGORIES if name != names[i]])
    planted = [Planted(frame, str(kinds[i]), truth.boxes[i]) for i in np.flatnonzero(kinds != "")]
    changed = replace(truth, boxes=boxes, categories=names)
    return changed.select(kinds != "missing"), planted


def planted_errors(data: Path, seed: int) -> list[Planted]:
    """Plant the errors in the label files of a simulated data set; return them."""
    original, generator = data / "original_2", np.random.default_rng(seed)
    labels = data / "training" / "label_2"
    if not original.exists():
        shutil.copytree(labels, original)
    for path in original.iterdir():
        shutil.copy(path, labels / path.name)
    dataset = KittiDataset(data)
    planted = []
    for frame in dataset.frame_ids():
        changed, errors = plant(dataset.annotations(frame), frame, generator)
        planted += errors
        calibration = dataset.read(frame, points=False).calibration
        write_objects(labels / f"{frame}.txt", from_annotations(changed, calibration))
    return planted


def hits(found: FoundSuspects, planted: Sequence[Planted]) -> Iterator[set[int]]:
    """Yield the planted errors at which each suspect points: its label, or the true box."""
    for suspect in found.suspects:
        frame = found.frames[suspect.frame]
        sides = (
            (frame.found, suspect.prediction),
            (frame.truth, suspect.label),
            (frame.masks, suspect.mask),
        )
        boxes = [objects.boxes[number] for objects, number in sides if number >= 0]
        yield {
            n
            for n, error in enumerate(planted)
            if error.frame == frame.frame and bev_iou(np.array(boxes), error.box[None]).max() > 0.1
        }


def measure(workspace: Workspace, planted: Sequence[Planted], folds: int) -> str:
    """Return the figures as a Markdown table."""
    request = SuspectRequest(("labeled",), folds)
    found = run_suspects(workspace, request, Silent(), print)
    pointed = list(hits(found, planted))
    frames = {each.frame for each in found.frames}
    own = {n for n, error in enumerate(planted) if error.frame in frames}
    chance = len(own) / found.labels
    lines = [
        f"{found.labels} labels of {len(frames)} frames, {len(own)} errors ({chance:.1%})",
        "",
        "| first | precision | errors found |",
        "|---|---|---|",
    ]
    for rank in (*RANKS, len(pointed)):
        first = pointed[:rank]
        some, right = set().union(*first), sum(map(bool, first))
        lines.append(f"| {rank} | {right / max(len(first), 1):.2f} | {len(some)} of {len(own)} |")
    every = set().union(*pointed)
    lines += ["", "| error | planted | among the first 50 | among all |", "|---|---|---|---|"]
    for kind in ("missing", "moved", "misnamed"):
        of_kind = {n for n in own if planted[n].kind == kind}
        first = len(of_kind & set().union(*pointed[:50]))
        lines.append(f"| {kind} | {len(of_kind)} | {first} | {len(of_kind & every)} |")
    lines.append("")
    lines += [
        f"{'+' if pointed[n] else '-'} {suspect.suspicion:.3f} {suspect.category}: {suspect.reason}"
        for n, suspect in enumerate(found.suspects[:50])
    ]
    return "\n".join(lines)


def main() -> None:
    """Simulate, plant, train and measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=80)
    parser.add_argument("--folds", type=int, default=2)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    data = options.folder / "data"
    simulate(data, options.frames + 1, options.seed, val_frames=1, workers=1)
    planted = planted_errors(data, options.seed)
    document = {
        "dataset": {"root": data},
        "segmenter": {"name": "simulated"},
        "train": {"pretrain_steps": options.steps, "threads": 1},
        "run": {"seed": options.seed, "workers": 1},
    }
    config = make_config(document, "measure_suspects")
    workspace = initialise(options.folder / "work", config, "1.0", "")
    print(measure(workspace, planted, options.folds))  # noqa: T201


if __name__ == "__main__":
    main()
