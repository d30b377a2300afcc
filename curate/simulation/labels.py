"""The ground truth of one scene, as KITTI defines it.

- 2D box: the tight box around the projection of the whole object, including occluded parts, clipped
  to the image.
- Truncation: the fraction of the unclipped 2D box outside the image.
- Occlusion: 0 if at least 80 percent of the object's pixels within the image are visible, 1 if at
  least 45 percent, else 2.

Objects without a visible pixel are not labeled. Tiny, very far or almost hidden objects become
DontCare regions.
"""

import numpy as np

from curate.detections import Annotations, as_categories
from curate.frames import Calibration
from curate.geometry.mounting import observation_angles
from curate.simulation.camera import View
from curate.simulation.rig import IMAGE_SIZE, CameraRig
from curate.simulation.scene import Caster, Scene

_NEAR_M = 0.2
_PROBES = 400  # approximate number of rays per object for its visible fraction
_FAR_M = 70.0
_MIN_HEIGHT_PX = 14.0
_MIN_VISIBLE_PX = 20
_MIN_VISIBLE_FRACTION = 0.12
_OCCLUSION_FRACTIONS = (0.8, 0.45)


def annotate(scene: Scene, view: View, rig: CameraRig) -> Annotations:
    """Return the labels of all visible objects, nearest first, with DontCare regions last."""
    calibration = rig.calibration
    seen = np.bincount(view.instances[view.instances > 0], minlength=len(scene.placements) + 1)
    numbers = [number for number in scene.actors() if seen[number]]
    if not numbers:
        return Annotations.empty()
    outlines = [_outline(scene, number, calibration) for number in numbers]
    boxes_2d = np.array([inside for inside, _ in outlines])
    truncated = np.array([1 - _area(inside) / _area(whole) for inside, whole in outlines])
    visible = _visible_fractions(scene, view, rig, numbers, boxes_2d)
    boxes = np.array([_box(scene, number) for number in numbers])
    categories = as_categories([scene.placements[number - 1].kind for number in numbers])

    distance = np.hypot(boxes[:, 0], boxes[:, 1])
    unclear = (distance > _FAR_M) | (boxes_2d[:, 3] - boxes_2d[:, 1] < _MIN_HEIGHT_PX)
    unclear |= (seen[numbers] < _MIN_VISIBLE_PX) | (visible < _MIN_VISIBLE_FRACTION)
    boxes[unclear] = np.nan
    annotations = Annotations(
        boxes,
        np.where(unclear, "DontCare", categories),
        np.where(unclear, -1.0, truncated),
        np.where(unclear, -1, np.digitize(-visible, -np.array(_OCCLUSION_FRACTIONS))),
        np.where(unclear, -10.0, observation_angles(boxes, calibration)),
        boxes_2d,
    )
    return annotations.select(np.lexsort((distance, unclear)))


def _box(scene: Scene, number: int) -> np.ndarray:
    """Return the (7,) tight box around an object in the LiDAR frame."""
    placement = scene.placements[number - 1]
    size = placement.mesh.size * placement.scale
    centre = placement.position + np.array([0, 0, size[2] / 2])
    return np.array([*centre, *size, placement.yaw_rad])


def _outline(scene: Scene, number: int, calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Return (4,) left, top, right, bottom of the object within the image, and of the whole object.

    The edges of the mesh are clipped to the view as segments in homogeneous coordinates. An object
    that extends beside or behind the camera thus gets the 2D box of its part within the image.
    """
    matrix = calibration.lidar_to_image
    corners = scene.instance_vertices(number) @ matrix[:, :3].T + matrix[:, 3]
    last = np.array(IMAGE_SIZE) - 1.0
    if corners[:, 2].min() > _NEAR_M:
        whole = _bounds(corners)
        if (whole[:2] >= 0).all() and (whole[2:] <= last).all():
            return whole, whole
    triangles = corners[scene.placements[number - 1].mesh.triangles]
    edges = np.stack([triangles, np.roll(triangles, 1, axis=1)], axis=2).reshape(-1, 2, 3)
    edges = _clip(edges, np.array([[0, 0, 1.0]]), np.array([_NEAR_M]))
    sides = np.array([[1, 0, 0], [-1, 0, last[0]], [0, 1, 0], [0, -1, last[1]]])
    inside = _bounds(_clip(edges, sides, np.zeros(4)))
    return np.clip(inside, 0, np.tile(last, 2)), _bounds(edges)


def _clip(edges: np.ndarray, planes: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return the parts of (n, 2, 3) segments where plane @ point >= offset for every plane.

    Segments entirely outside a plane are dropped. If one end is outside, it is replaced by the
    intersection with the plane. For example, x >= 0 clips the segment from (-1, 0, 1) to (3, 4, 1)
    to the segment from (0, 1, 1) to (3, 4, 1).
    """
    for plane, offset in zip(planes, offsets, strict=True):
        distance = edges @ plane - offset
        kept = (distance >= 0).any(axis=1)
        edges, distance = edges[kept], distance[kept]
        span = distance[:, 0] - distance[:, 1]
        fraction = distance[:, 0] / np.where(span == 0, 1, span)
        cut = edges[:, 0] + fraction[:, None] * (edges[:, 1] - edges[:, 0])
        edges = np.where((distance < 0)[..., None], cut[:, None], edges)
    return edges


def _bounds(homogeneous: np.ndarray) -> np.ndarray:
    """Return (4,) left, top, right, bottom in pixels of (..., 3) homogeneous points."""
    points = homogeneous.reshape(-1, 3)
    pixels = points[:, :2] / points[:, 2:]
    return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])


def _area(box_2d: np.ndarray) -> float:
    return float((box_2d[2] - box_2d[0]) * (box_2d[3] - box_2d[1]))


def _visible_fractions(
    scene: Scene, view: View, rig: CameraRig, numbers: list[int], boxes_2d: np.ndarray
) -> np.ndarray:
    """Return (n,) the visible fraction of each object's pixels in the image.

    The pixels are a grid in the object's 2D box. Where the object is not visible, rays are cast
    into a scene of the actors alone, with all hits along each ray: an object covers the pixels with
    a hit on it, visible or not.
    """
    actors = np.isin(scene.instances, numbers)
    rows = np.flatnonzero(actors)
    alone = Caster(scene.vertices, scene.triangles[rows])
    pixels = [_probe_pixels(box_2d) for box_2d in boxes_2d]
    owner = np.repeat(numbers, [len(part) for part in pixels])
    pixel = np.concatenate(pixels)
    visible = view.instances.ravel()[pixel] == owner
    elsewhere = np.flatnonzero(~visible)
    ray, triangle = alone.all_hits(rig.rays(pixel[elsewhere]))
    covered = visible.copy()
    hit = elsewhere[ray]
    covered[hit[scene.instances[rows[triangle]] == owner[hit]]] = True
    size = int(max(numbers)) + 1
    covered_count = np.bincount(owner[covered], minlength=size)
    visible_count = np.bincount(owner[visible], minlength=size)
    return np.asarray(visible_count[numbers] / np.maximum(covered_count[numbers], 1))


def _probe_pixels(box_2d: np.ndarray) -> np.ndarray:
    """Return the indices (row * width + column) of a grid of pixels in a 2D box."""
    left, top = np.ceil(box_2d[:2]).astype(int)
    right, bottom = np.floor(box_2d[2:]).astype(int)
    step = max(1, int(np.sqrt((right - left + 1) * (bottom - top + 1) / _PROBES)))
    rows, columns = np.meshgrid(
        np.arange(top, bottom + 1, step), np.arange(left, right + 1, step), indexing="ij"
    )
    return np.asarray(rows * IMAGE_SIZE[0] + columns).ravel()
