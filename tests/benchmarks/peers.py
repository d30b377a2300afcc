"""The same work with other libraries, each as a careful user would write it.

Every peer is prepared first: conversions to its own format are outside the measured time.
"""

from collections.abc import Callable

import numpy as np

from curate.geometry.boxes import bev_corners

Counter = Callable[[], np.ndarray]
Pairs = tuple[np.ndarray, np.ndarray]


def count_with_open3d(points: np.ndarray, boxes: np.ndarray) -> Counter:
    """Count with Open3D's oriented bounding boxes, one after the other."""
    from curate.simulation.open3d_loader import load

    open3d = load()
    cloud = open3d.utility.Vector3dVector(points[:, :3].astype(np.float64))
    oriented = [
        open3d.geometry.OrientedBoundingBox(
            box[:3],
            open3d.geometry.get_rotation_matrix_from_xyz(np.array([0, 0, box[6]])),
            box[3:6],
        )
        for box in boxes
    ]
    return lambda: np.array(
        [len(box.get_point_indices_within_bounding_box(cloud)) for box in oriented]
    )


def count_with_numpy(points: np.ndarray, boxes: np.ndarray) -> Counter:
    """Count with NumPy, one box after the other against all points."""
    columns = np.ascontiguousarray(points[:, :3].T)

    def count() -> np.ndarray:
        return np.array([np.count_nonzero(_inside(columns, box)) for box in boxes])

    return count


def count_with_sorted_numpy(points: np.ndarray, boxes: np.ndarray) -> Counter:
    """Count with NumPy and points sorted by x: each box checks only its own slab."""

    def count() -> np.ndarray:
        columns = np.ascontiguousarray(points[np.argsort(points[:, 0]), :3].T)
        reach = np.hypot(boxes[:, 3], boxes[:, 4]) / 2
        first = np.searchsorted(columns[0], boxes[:, 0] - reach)
        last = np.searchsorted(columns[0], boxes[:, 0] + reach, side="right")
        return np.array(
            [
                np.count_nonzero(_inside(columns[:, start:end], box))
                for box, start, end in zip(boxes, first, last, strict=True)
            ]
        )

    return count


def count_with_torch(points: np.ndarray, boxes: np.ndarray) -> Counter:
    """Count with torch, all boxes against all points at once."""
    import torch

    cloud, all_boxes = torch.from_numpy(points[:, :3]), torch.from_numpy(boxes.astype(np.float32))
    cos, sin = torch.cos(all_boxes[:, 6:]), torch.sin(all_boxes[:, 6:])
    half = all_boxes[:, 3:6] / 2

    def count() -> np.ndarray:
        x, y, z = (cloud[:, axis] - all_boxes[:, axis, None] for axis in range(3))
        inside = (cos * x + sin * y).abs() <= half[:, :1]
        inside &= (cos * y - sin * x).abs() <= half[:, 1:2]
        inside &= z.abs() <= half[:, 2:]
        return inside.sum(dim=1).numpy()

    return count


def _inside(columns: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return (p,) bool, which of (3, p) points are in a box.

    Only those at its height are rotated.
    """
    half = (box[3:6] / 2).astype(np.float32)
    x, y, z = (columns[axis] - np.float32(box[axis]) for axis in range(3))
    cos, sin = np.float32(np.cos(box[6])), np.float32(np.sin(box[6]))
    inside = np.abs(z) <= half[2]
    inside &= np.abs(cos * x + sin * y) <= half[0]
    inside &= np.abs(cos * y - sin * x) <= half[1]
    return np.asarray(inside)


def near_pairs(a: np.ndarray, b: np.ndarray) -> Pairs:
    """Return rows of (n, 7) and (m, 7) boxes with intersecting circumscribed circles."""
    rows_a, rows_b = near_pairs_of_groups(a[None], b[None])
    return rows_a, rows_b


def near_pairs_of_groups(a: np.ndarray, b: np.ndarray) -> Pairs:
    """Return rows of (g, n, 7) and (g, m, 7) boxes, flat, with circles that meet in a group."""
    radius_a, radius_b = (np.hypot(boxes[..., 3], boxes[..., 4]) / 2 for boxes in (a, b))
    away_x = a[:, :, None, 0] - b[:, None, :, 0]
    away_y = a[:, :, None, 1] - b[:, None, :, 1]
    reach = radius_a[:, :, None] + radius_b[:, None]
    group, i, j = np.nonzero(away_x**2 + away_y**2 < reach**2)
    return group * a.shape[1] + i, group * b.shape[1] + j


def iou_of_pairs(a: np.ndarray, b: np.ndarray, common: np.ndarray) -> np.ndarray:
    """Return (p,) BEV IoU of (p, 7) boxes from their common areas."""
    return np.asarray(common / (a[:, 3] * a[:, 4] + b[:, 3] * b[:, 4] - common))


def shapely_common_areas(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return (p,) common areas of the footprints of (p, 7) boxes by shapely, that is GEOS."""
    import shapely

    polygons_a, polygons_b = shapely.polygons(bev_corners(a)), shapely.polygons(bev_corners(b))
    return np.asarray(shapely.area(shapely.intersection(polygons_a, polygons_b)))


def cv2_common_areas(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return (p,) common areas of the footprints of (p, 7) boxes by OpenCV, pair by pair."""
    import cv2

    common = np.zeros(len(a))
    rectangles = zip(cv2_rectangles(a), cv2_rectangles(b), strict=True)
    for pair, (one, other) in enumerate(rectangles):
        _, region = cv2.rotatedRectangleIntersection(one, other)
        if region is not None:
            common[pair] = cv2.contourArea(cv2.convexHull(region))
    return common


def torch_common_areas(boxes_a: np.ndarray, boxes_b: np.ndarray) -> np.ndarray:
    """Return (p,) common areas of the footprints of (p, 7) boxes by torch, all at once.

    The usual way: the corners of the common polygon, sorted by angle.
    """
    import torch

    a, b = torch.from_numpy(bev_corners(boxes_a)), torch.from_numpy(bev_corners(boxes_b))
    edges_a, edges_b = a.roll(-1, 1) - a, b.roll(-1, 1) - b

    def cross(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]

    def inside(points: torch.Tensor, corners: torch.Tensor, edges: torch.Tensor) -> torch.Tensor:
        left_of = cross(edges[:, None], points[:, :, None] - corners[:, None])
        return (left_of >= -1e-9).all(dim=2)

    away = b[:, None] - a[:, :, None]
    turn = cross(edges_a[:, :, None], edges_b[:, None])
    along_a = cross(away, edges_b[:, None].expand_as(away)) / turn
    along_b = cross(away, edges_a[:, :, None].expand_as(away)) / turn
    crossing = (along_a >= 0) & (along_a <= 1) & (along_b >= 0) & (along_b <= 1)
    crossings = a[:, :, None] + along_a.nan_to_num(0, 0, 0)[..., None] * edges_a[:, :, None]
    points = torch.cat([a, b, crossings.flatten(1, 2)], dim=1)
    valid = torch.cat([inside(a, b, edges_b), inside(b, a, edges_a), crossing.flatten(1)], dim=1)
    counts = valid.sum(dim=1, keepdim=True).clamp(min=1)
    middle = (points * valid[..., None]).sum(dim=1, keepdim=True) / counts[..., None]
    away = torch.where(valid[..., None], points - middle, 0.0)
    angle = torch.where(valid, torch.atan2(away[..., 1], away[..., 0]), torch.inf)
    order = angle.argsort(dim=1)
    ring = away.gather(1, order[..., None].expand_as(away))
    # The ring closes at its first point; invalid points repeat that point.
    ring = torch.where(valid.gather(1, order)[..., None], ring, ring[:, :1])
    return np.asarray(cross(ring, ring.roll(-1, 1)).sum(dim=1).clamp(min=0) / 2)


def shapely_nms(boxes: np.ndarray, scores: np.ndarray, threshold: float) -> np.ndarray:
    """Greedy NMS with shapely's overlaps: the tree finds the pairs, Python suppresses."""
    import shapely

    polygons = shapely.polygons(bev_corners(boxes))
    rows, others = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    upper = rows < others
    rows, others = rows[upper], others[upper]
    common = shapely.area(shapely.intersection(polygons[rows], polygons[others]))
    areas = boxes[:, 3] * boxes[:, 4]
    over = common / (areas[rows] + areas[others] - common) > threshold
    rivals: list[list[int]] = [[] for _ in boxes]
    for i, j in zip(rows[over].tolist(), others[over].tolist(), strict=True):
        rivals[i].append(j)
        rivals[j].append(i)
    kept, suppressed = [], np.zeros(len(boxes), dtype=bool)
    for i in np.argsort(-scores, kind="stable").tolist():
        if not suppressed[i]:
            kept.append(i)
            suppressed[rivals[i]] = True
    return np.array(kept)


def torch_nms(boxes: np.ndarray, scores: np.ndarray, threshold: float) -> np.ndarray:
    """Greedy NMS with torch's overlaps: each kept box against the rest with circles that meet."""
    order = np.argsort(-scores, kind="stable")
    ranked = boxes[order]
    radius, areas = np.hypot(ranked[:, 3], ranked[:, 4]) / 2, ranked[:, 3] * ranked[:, 4]
    kept, suppressed = [], np.zeros(len(boxes), dtype=bool)
    for i in range(len(boxes)):
        if suppressed[i]:
            continue
        kept.append(i)
        away = ((ranked[i + 1 :, :2] - ranked[i, :2]) ** 2).sum(axis=1)
        near = (away < (radius[i + 1 :] + radius[i]) ** 2) & ~suppressed[i + 1 :]
        rest = i + 1 + np.flatnonzero(near)
        if len(rest):
            one = np.broadcast_to(ranked[i], (len(rest), 7))
            common = torch_common_areas(one, ranked[rest])
            suppressed[rest[common / (areas[i] + areas[rest] - common) > threshold]] = True
    return np.asarray(order[kept])


def cv2_nms(boxes: np.ndarray, scores: np.ndarray, threshold: float) -> np.ndarray:
    """OpenCV's own greedy NMS of rotated rectangles, in C++."""
    import cv2

    kept = cv2.dnn.NMSBoxesRotated(cv2_rectangles(boxes), scores.tolist(), 0.0, threshold)
    return np.asarray(kept).reshape(-1)


def cv2_rectangles(boxes: np.ndarray) -> list[tuple]:
    """Return footprints in OpenCV's format: centre, sides, degrees."""
    return [
        ((x, y), (length, width), np.degrees(yaw))
        for x, y, _, length, width, _, yaw in boxes.tolist()
    ]
