"""The geometry kernels against other libraries, on the same data and with the same answer."""

from collections.abc import Callable

import numpy as np
import pytest
from benchmarks import peers, scenes
from benchmarks.measuring import OURS, measure

from curate.geometry.nms import nms_bev
from curate.geometry.overlap import bev_iou, overlapping_pairs
from curate.geometry.points_in_boxes import count_points_in_boxes

NMS_IOU = 0.2
# OpenCV calculates in float32, so that its borderline cases fall otherwise.
CV2_TOLERANCE = 2e-2

COUNTERS: dict[str, Callable] = {
    OURS: lambda points, boxes: lambda: count_points_in_boxes(points, boxes),
    "NumPy, sorted by x": peers.count_with_sorted_numpy,
    "NumPy, box by box": peers.count_with_numpy,
    "Open3D": peers.count_with_open3d,
    "torch": peers.count_with_torch,
}
SUPPRESSORS: dict[str, Callable] = {
    OURS: nms_bev,
    "OpenCV (NMSBoxesRotated)": peers.cv2_nms,
    "torch": peers.torch_nms,
    "shapely": peers.shapely_nms,
}
OVERLAPS: dict[str, Callable] = {
    OURS: bev_iou,
    "torch": peers.torch_iou,
    "OpenCV": peers.cv2_iou,
    "shapely": peers.shapely_iou,
}


@pytest.mark.parametrize("name", COUNTERS)
def bench_points_in_boxes(benchmark, name):
    """How many of the points of a sweep lie in each box."""
    generator = np.random.default_rng(0)
    points, boxes = scenes.sweep(generator, 120_000), scenes.scattered_boxes(generator, 50, 40)
    counts = measure(
        benchmark,
        COUNTERS[name](points, boxes),
        group="Points in boxes: 120,000 points, 50 boxes",
        name=name,
        amount=len(points),
        unit="points",
        target_s=1e-3 if name == OURS else None,
    )
    expected = count_points_in_boxes(points, boxes)
    assert expected.sum() > 1000
    # A point on a face may fall to either side in float32.
    np.testing.assert_allclose(counts, expected, atol=2)


@pytest.mark.parametrize("name", SUPPRESSORS)
def bench_nms(benchmark, name):
    """Which of many guesses around each of 256 objects stay."""
    generator = np.random.default_rng(1)
    boxes = scenes.clustered_boxes(generator, 256, 16)
    scores = generator.random(len(boxes))
    kept = measure(
        benchmark,
        lambda: SUPPRESSORS[name](boxes, scores, NMS_IOU),
        group="Rotated NMS: 4,096 clustered boxes",
        name=name,
        amount=len(boxes),
        unit="boxes",
        target_s=5e-3 if name == OURS else None,
    )
    expected = set(nms_bev(boxes, scores, NMS_IOU).tolist())
    assert 100 < len(expected) < 2000
    odd = expected ^ set(kept.tolist())
    assert len(odd) <= (CV2_TOLERANCE * len(expected) if "OpenCV" in name else 0)


@pytest.mark.parametrize("name", OVERLAPS)
def bench_iou_of_frames(benchmark, name):
    """BEV IoU of predictions and labels, frame by frame."""
    generator = np.random.default_rng(2)
    frames, each = 500, 20
    a = scenes.scattered_boxes(generator, frames * each, 20)
    b = a + generator.normal(0, 0.1, a.shape)
    starts = np.arange(frames + 1) * each

    def ours() -> float:
        return float(overlapping_pairs(a, starts, b, starts)[2].sum())

    def peer() -> float:
        pairs = zip(a.reshape(frames, each, 7), b.reshape(frames, each, 7), strict=True)
        return float(sum(OVERLAPS[name](one, other).sum() for one, other in pairs))

    total = measure(
        benchmark,
        ours if name == OURS else peer,
        group="BEV IoU: 500 frames, 20 x 20 boxes each",
        name=name,
        amount=frames,
        unit="frames",
    )
    assert total == pytest.approx(ours(), rel=CV2_TOLERANCE if name == "OpenCV" else 1e-6)


@pytest.mark.parametrize("name", OVERLAPS)
def bench_iou_dense(benchmark, name):
    """BEV IoU of all boxes with all others, crowded."""
    generator = np.random.default_rng(3)
    a, b = (scenes.scattered_boxes(generator, 1000, 20) for _ in range(2))
    overlaps = measure(
        benchmark,
        lambda: OVERLAPS[name](a, b),
        group="BEV IoU: 1,000 x 1,000 boxes on 40 x 40 m",
        name=name,
        amount=len(a) * len(b),
        unit="pairs",
    )
    expected = bev_iou(a, b)
    assert np.count_nonzero(expected) > 1000
    np.testing.assert_allclose(
        overlaps, expected, atol=CV2_TOLERANCE if name == "OpenCV" else 1e-6
    )
