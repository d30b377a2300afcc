"""The geometry kernels against other libraries, on the same data and with the same results."""

from collections.abc import Callable

import numpy as np
import pytest
from benchmarks import peers, scenes
from benchmarks.measuring import OURS, cpu_seconds, measure

from curate.geometry.nms import nms_bev
from curate.geometry.overlap import bev_iou, overlapping_pairs
from curate.geometry.points_in_boxes import count_points_in_boxes

pytestmark = pytest.mark.benchmark(timer=cpu_seconds)

NMS_IOU = 0.2
# OpenCV calculates in float32, so its borderline cases can differ.
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
COMMON_AREAS: dict[str, Callable] = {
    "torch": peers.torch_common_areas,
    "OpenCV": peers.cv2_common_areas,
    "shapely": peers.shapely_common_areas,
}


@pytest.mark.parametrize("name", COUNTERS)
def bench_points_in_boxes(benchmark, name):
    """Count the points of a sweep in each box."""
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
    # A point on a face can be on either side in float32.
    np.testing.assert_allclose(counts, expected, atol=2)


@pytest.mark.parametrize("name", SUPPRESSORS)
def bench_nms(benchmark, name):
    """Suppress many overlapping detections around each of 256 objects."""
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


@pytest.mark.parametrize("name", [OURS, *COMMON_AREAS])
def bench_iou_of_frames(benchmark, name):
    """Compute BEV IoU of predictions and labels within each frame.

    Peers get all near pairs at once.
    """
    generator = np.random.default_rng(2)
    frames, each = 500, 20
    a = scenes.scattered_boxes(generator, frames * each, 20)
    b = a + generator.normal(0, 0.1, a.shape)
    starts = np.arange(frames + 1) * each

    def ours() -> np.ndarray:
        return overlapping_pairs(a, starts, b, starts)[2]

    def peer() -> np.ndarray:
        shape = (frames, each, 7)
        rows_a, rows_b = peers.near_pairs_of_groups(a.reshape(shape), b.reshape(shape))
        pairs = a[rows_a], b[rows_b]
        return peers.iou_of_pairs(*pairs, COMMON_AREAS[name](*pairs))

    overlaps = measure(
        benchmark,
        ours if name == OURS else peer,
        group="BEV IoU: 500 frames, 20 x 20 boxes each",
        name=name,
        amount=frames,
        unit="frames",
    )
    expected = ours()
    assert len(expected) >= frames * each
    tolerance = CV2_TOLERANCE if name == "OpenCV" else 1e-6
    assert overlaps.sum() == pytest.approx(expected.sum(), rel=tolerance)


@pytest.mark.parametrize("name", [OURS, *COMMON_AREAS])
def bench_iou_dense(benchmark, name):
    """Compute BEV IoU of all boxes with all others, crowded; peers get the near pairs first."""
    generator = np.random.default_rng(3)
    a, b = (scenes.scattered_boxes(generator, 1000, 20) for _ in range(2))

    def peer() -> np.ndarray:
        rows = peers.near_pairs(a, b)
        pairs = a[rows[0]], b[rows[1]]
        matrix = np.zeros((len(a), len(b)))
        matrix[rows] = peers.iou_of_pairs(*pairs, COMMON_AREAS[name](*pairs))
        return matrix

    overlaps = measure(
        benchmark,
        (lambda: bev_iou(a, b)) if name == OURS else peer,
        group="BEV IoU: 1,000 x 1,000 boxes on 40 x 40 m",
        name=name,
        amount=len(a) * len(b),
        unit="pairs",
    )
    expected = bev_iou(a, b)
    assert np.count_nonzero(expected) > 1000
    tolerance = CV2_TOLERANCE if name == "OpenCV" else 1e-6
    np.testing.assert_allclose(overlaps, expected, atol=tolerance)
