"""KITTI's average precision over a validation split of its usual size."""

import os
from pathlib import Path

import numpy as np
import pytest
from benchmarks.measuring import cpu_seconds, measure
from benchmarks.scenes import kitti_frames
from support.paths import ROOT

from curate.datasets.kitti.labels import write_objects
from curate.evaluation.kitti_ap import evaluate
from curate.evaluation.kitti_folders import read_folders

pytestmark = pytest.mark.benchmark(timer=cpu_seconds)

FRAMES = 3769
GROUP = f"KITTI AP: {FRAMES:,} frames, 3 categories, all metrics, R11 and R40"
EXAMPLES = ROOT.parent / "shared" / "kitti_eval"


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return a folder of label files and one of result files."""
    examples = Path(os.environ.get("CURATE_KITTI_EVAL", EXAMPLES))
    root = tmp_path_factory.mktemp("kitti")
    frames = kitti_frames(np.random.default_rng(0), FRAMES, examples if examples.is_dir() else None)
    for folder, objects in zip(("label_2", "results"), frames, strict=True):
        (root / folder).mkdir()
        for i, one in enumerate(objects):
            write_objects(root / folder / f"{i:06d}.txt", one)
    return root / "label_2", root / "results"


def bench_load(benchmark, folders):
    """Load two folders of text files."""
    names, _, _ = measure(
        benchmark,
        lambda: read_folders(*folders),
        group=GROUP,
        name="load labels and results",
        amount=FRAMES,
        unit="frames",
        target_s=2.0,
        figure="rate",
    )
    assert len(names) == FRAMES


def bench_evaluate(benchmark, folders):
    """Compute everything that `curate evaluate` prints."""
    _, labels, results = read_folders(*folders)
    found = measure(
        benchmark,
        lambda: evaluate(labels, results),
        group=GROUP,
        name="evaluate",
        amount=FRAMES,
        unit="frames",
        target_s=2.0,
        figure="rate",
    )
    assert (found.objects > 500).all()
    assert (found.ap_r40 > 0).all()
