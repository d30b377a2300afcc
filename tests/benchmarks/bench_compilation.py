"""Compilation cost of numba's kernels: once per machine, and in every process."""

import os
import subprocess
import sys

import pytest
from benchmarks.measuring import cpu_seconds_of_children, measure

pytestmark = pytest.mark.benchmark(timer=cpu_seconds_of_children)

GROUP = "First answer of the kernels, a whole Python process each"
IMPORTS = """
import numpy as np
from curate.datasets.kitti.labels import KittiObjects
from curate.evaluation.kitti_ap import evaluate
from curate.geometry.nms import nms_bev
from curate.geometry.overlap import bev_iou, iou_3d, overlapping_pairs
from curate.geometry.points_in_boxes import box_of_points, count_points_in_boxes
"""
CALLS = """
boxes, scores, starts = np.ones((2, 7)), np.ones(2), np.array([0, 2])
points = np.ones((3, 4), dtype=np.float32)
bev_iou(boxes, boxes), iou_3d(boxes, boxes), overlapping_pairs(boxes, starts, boxes, starts)
nms_bev(boxes, scores, 0.5), count_points_in_boxes(points, boxes), box_of_points(points, boxes)
nothing = KittiObjects.empty()
one = KittiObjects(
    np.array(["Car"]), np.zeros(1), np.zeros(1, dtype=np.int64), np.zeros(1),
    np.array([[0.0, 0, 100, 100]]), np.ones((1, 3)), np.ones((1, 3)), np.zeros(1), np.ones(1),
)
evaluate([one], [one])
"""
LINES = {
    "imports alone": ("warm", IMPORTS),
    "kernels from the cache on disk": ("warm", IMPORTS + CALLS),
    "kernels compiled (empty cache)": ("cold", IMPORTS + CALLS),
}


@pytest.fixture(scope="module")
def warm_cache(tmp_path_factory):
    """Return a cache that contains every kernel."""
    folder = tmp_path_factory.mktemp("warm")
    _run(IMPORTS + CALLS, folder)
    return folder


@pytest.mark.parametrize("name", LINES)
def bench_first_answer(benchmark, name, warm_cache, tmp_path_factory):
    """Measure a process that imports, and then calls every kernel once."""
    cache, code = LINES[name]
    before = _files(warm_cache)
    assert before

    def setup() -> tuple[tuple, dict]:
        folder = tmp_path_factory.mktemp("cold") if cache == "cold" else warm_cache
        return (code, folder), {}

    measure(
        benchmark,
        _run,
        group=GROUP,
        name=name,
        amount=1,
        unit="processes",
        setup=setup,
        rounds=2 if cache == "cold" else 4,
        figure="time",
    )
    # Compiled at most once per machine: a filled cache is not written again.
    assert _files(warm_cache) == before


def _run(code, folder):
    subprocess.run(
        [sys.executable, "-c", code],
        check=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(folder)},
    )


def _files(folder):
    return {(path, path.stat().st_mtime_ns) for path in folder.rglob("*.nb*")}
