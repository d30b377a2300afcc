"""Candidates for missed objects: image masks without a label, with a box from the points behind.

Each mask of a category is one candidate: an instance, or a connected part of the semantic map. The
pixels and points of labels are taken out of it first. The LiDAR points that project into the rest
are grouped by their distances, without ground, and the group with the most points is the object.
Its heading is that of the rectangle with the sides closest to the points (Zhang et al., "Efficient
L-Shape Fitting for Vehicle Detection Using Laser Scanners", IV 2017). Its size is the mean of the
category in X_l, or larger if the points are, and it extends from the sides that the LiDAR sees.

A proposal is a place to look at, not a label: it has no score and no weight.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from curate.detections import Annotations, Columns, as_categories, empty_boxes
from curate.frames import Frame
from curate.geometry.boxes import as_boxes
from curate.geometry.ground import GroundMap
from curate.geometry.overlap import bev_iou
from curate.geometry.points_in_boxes import box_of_points
from curate.geometry.projection import image_rectangles, project_points
from curate.geometry.similarity import wrap_angle
from curate.segmenters.base import Segmenter, SemanticMap
from curate.shapes import Bool, Float, Int, Shaped

PROVENANCE = "proposal"


@dataclass(frozen=True)
class ProposalSettings:
    """What counts as a candidate.

    Attributes:
        fewest_pixels: smaller masks are left out.
        fewest_points: objects with fewer LiDAR points are left out.
        own_share: of a category that shares classes with others, at least this share of a mask has
            classes of its own.
        apart_metres: points of one object are at most this far apart, and 1 % of the distance more.
        ground_metres: points up to this height above the ground are ground.
        label_margin: labels are enlarged on all sides by this, in metres and in shares of their
            rectangle in the image.
        largest: size of a box, relative to the mean of its category, at most.
        overlap: a proposal with a greater BEV IoU with a label or a better proposal is left out.
    """

    fewest_pixels: int = 40
    fewest_points: int = 5
    own_share: float = 0.1
    apart_metres: float = 0.5
    ground_metres: float = 0.2
    label_margin: float = 0.15
    largest: float = 1.3
    overlap: float = 0.1


_DEFAULT = ProposalSettings()


@dataclass(frozen=True)
class Proposals(Columns):
    """The n proposals of a frame, those with the most points first.

    Attributes:
        boxes: (n, 7) in the LiDAR frame.
        categories: (n,) str.
        points: (n,) LiDAR points of the object.
        pixels: (n,) pixels of its mask that no label covers.
        cameras: (n,) str, the camera that shows it; "" if the frame has only one.
    """

    boxes: Float[np.ndarray, "n 7"]
    categories: Shaped[np.ndarray, " n"]
    points: Int[np.ndarray, " n"]
    pixels: Int[np.ndarray, " n"]
    cameras: Shaped[np.ndarray, " n"]

    @classmethod
    def empty(cls) -> "Proposals":
        """Return zero proposals."""
        names, numbers = as_categories([]), np.zeros(0, dtype=np.int64)
        return cls(empty_boxes(), names, numbers, numbers, names)


def propose_objects(
    frame: Frame,
    segmenter: Segmenter,
    labels: Float[np.ndarray, "m 7"],
    sizes: Mapping[str, Float[np.ndarray, " 3"]],
    settings: ProposalSettings = _DEFAULT,
    regions: Float[np.ndarray, "r 4"] | None = None,
) -> Proposals:
    """Return the candidates for objects of a frame that have no label.

    Args:
        frame: a frame with points and a camera.
        segmenter: provides the semantic maps, and instances if it has them.
        labels: (m, 7) boxes of the labels, of all categories.
        sizes: (3,) mean length, width and height of each category to propose.
        settings: see `ProposalSettings`.
        regions: (r, 4) left, top, right, bottom of parts of the first image to leave out, such as
            DontCare regions.
    """
    points = frame.points[:, :3].astype(np.float64)
    height = points[:, 2] - _heights(points)
    enlarged = as_boxes(labels) + np.array([0, 0, 0, *[2 * settings.label_margin] * 3, 0])
    free = (box_of_points(points, enlarged) < 0) & (height > settings.ground_metres)
    points, bottom = points[free], (points[:, 2] - height)[free]
    found = []
    for view in frame.views():
        semantic_map = segmenter.segment(view)
        pixels, depth = project_points(points, view.calibration)
        columns, rows = _pixel_numbers(pixels)
        h, w = semantic_map.class_ids.shape
        seen = (depth > 0) & (columns >= 0) & (columns < w) & (rows >= 0) & (rows < h)
        hidden = _under_labels(labels, view, settings.label_margin)
        if regions is not None and view.camera == frame.camera:
            _hide(hidden, regions, 0.0)
        for category, mask in candidate_masks(semantic_map, tuple(sizes), hidden, settings):
            behind = np.flatnonzero(seen)
            behind = behind[mask[rows[behind], columns[behind]]]
            group = behind[largest_group(points[behind], settings.apart_metres)]
            if len(group) < settings.fewest_points:
                continue
            size = np.asarray(sizes[category], dtype=np.float64)
            box = fit_box(points[group], size, float(np.median(bottom[group])), settings.largest)
            found.append((box, category, len(group), int(mask.sum()), view.camera))
    return _without_overlaps(found, labels, settings.overlap)


def candidate_masks(
    semantic_map: SemanticMap,
    categories: Sequence[str],
    hidden: Bool[np.ndarray, "height width"],
    settings: ProposalSettings = _DEFAULT,
) -> list[tuple[str, Bool[np.ndarray, "height width"]]]:
    """Return the masks of objects, each with its category.

    Without instances they are the connected parts of the pixels of a category. Where classes belong
    to several categories, as a person to Pedestrian and Cyclist, the category with more classes
    comes first, and needs pixels of a class of its own, as those of a bicycle.

    Args:
        semantic_map: see `SemanticMap`.
        categories: the categories to return.
        hidden: pixels that are taken out.
        settings: see `ProposalSettings`.
    """
    classes = {name: set(semantic_map.category_classes.get(name, ())) for name in categories}
    free = ~hidden
    masks = []
    for name in sorted(categories, key=lambda each: -len(classes[each])):
        others = set().union(*(ids for other, ids in classes.items() if other != name))
        own = classes[name] - others
        of_category = free & np.isin(semantic_map.class_ids, list(classes[name]))
        for mask in _parts(of_category, semantic_map.instances, settings.fewest_pixels):
            enough = True
            if own and len(own) < len(classes[name]):
                special = int(np.isin(semantic_map.class_ids[mask], list(own)).sum())
                enough = special >= settings.own_share * int(mask.sum())
            if enough:
                masks.append((name, mask))
                free &= ~mask
    return masks


def largest_group(points: Float[np.ndarray, "n 3"], apart: float) -> Int[np.ndarray, " g"]:
    """Return the indices of the largest group of points that are near each other, ascending.

    Two points are neighbours if they are at most `apart` metres and 1 % of the distance from the
    LiDAR apart; a group is everything that neighbours connect. Of equal groups, the nearest counts.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    n = len(points)
    if n == 0:
        return np.zeros(0, dtype=np.int64)
    reach = np.hypot(points[:, 0], points[:, 1])
    pairs = cKDTree(points).query_pairs(apart + 0.01 * float(reach.max()), output_type="ndarray")
    between = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    pairs = pairs[between <= apart + 0.01 * reach[pairs].min(axis=1)]
    edges = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    count, group = connected_components(edges, directed=False)
    members = np.bincount(group, minlength=count)
    nearest = np.full(count, np.inf)
    np.minimum.at(nearest, group, reach)
    return np.flatnonzero(group == np.lexsort((nearest, -members))[0])


def fit_box(
    points: Float[np.ndarray, "n 3"], size: Float[np.ndarray, " 3"], bottom: float, largest: float
) -> Float[np.ndarray, " 7"]:
    """Return the box of an object of a category from its LiDAR points.

    The longer side of the points is the length, unless it is not longer than the width can be: then
    the LiDAR sees the front or the rear, and the length points away from it.

    Args:
        points: (n, 3) of the object in the LiDAR frame.
        size: (3,) mean length, width and height of the category.
        bottom: z of the ground below.
        largest: the box is at most this many times the mean size.
    """
    angle = closest_angle(points[:, :2])
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    along = points[:, :2] @ turn.T
    low, high = along.min(axis=0), along.max(axis=0)
    extent = high - low
    longer = int(extent[1] > extent[0])
    length_axis = longer if extent[longer] > 1.2 * size[1] else 1 - longer
    sides = size[:2] if length_axis == 0 else size[[1, 0]]
    sides = np.clip(extent, sides, largest * sides)
    # The LiDAR is at the origin: a side that it sees is where the points are.
    centre = np.where(low > 0, low + sides / 2, np.where(high < 0, high - sides / 2, 0))
    centre = np.where((low <= 0) & (high >= 0), (low + high) / 2, centre)
    tall = float(np.clip(points[:, 2].max() - bottom, size[2] * 0.8, size[2] * largest))
    length, width = sides[length_axis], sides[1 - length_axis]
    yaw = float(wrap_angle(np.float64(angle + length_axis * np.pi / 2)))
    return np.array([*(centre @ turn), bottom + tall / 2, length, width, tall, yaw])


def closest_angle(places: Float[np.ndarray, "n 2"], steps: int = 90) -> float:
    """Return the angle in [0, pi/2) of the rectangle with the sides closest to the points.

    That is the largest sum of 1 / distance to the nearer side (Zhang et al. 2017, Algorithm 3),
    with at least 5 cm for each distance.
    """
    best, found = -np.inf, 0.0
    for angle in np.arange(steps) * (np.pi / 2 / steps):
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        along = places @ turn.T
        low, high = along.min(axis=0), along.max(axis=0)
        # Per axis, all points belong to the side that they are closer to.
        to_low, to_high = along - low, high - along
        nearer = np.where((to_low**2).sum(0) < (to_high**2).sum(0), to_low, to_high).min(axis=1)
        score = float((1 / np.maximum(nearer, 0.05)).sum())
        if score > best:
            best, found = score, float(angle)
    return found


def mean_sizes(truth: Sequence[Annotations], categories: Sequence[str]) -> dict[str, np.ndarray]:
    """Return (3,) mean length, width and height of each category with objects."""
    boxes = np.concatenate([empty_boxes(), *(each.boxes for each in truth)])
    names = np.concatenate([as_categories([]), *(each.categories for each in truth)])
    known = ~np.isnan(boxes).any(axis=1)
    return {
        name: boxes[known & (names == name), 3:6].mean(axis=0)
        for name in categories
        if (known & (names == name)).any()
    }


def _heights(points: np.ndarray) -> np.ndarray:
    """Return (n,) z of the ground below points; the lowest z of all where it is not known."""
    if len(points) == 0:
        return np.zeros(0)
    heights = GroundMap.of(points).at(points[:, :2])
    return np.where(np.isnan(heights), points[:, 2].min(), heights)


def _pixel_numbers(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns and rows of (n, 2) image places; -1 for invalid or far ones."""
    valid = np.isfinite(pixels).all(axis=1) & (np.abs(pixels) < 1e6).all(axis=1)
    rounded = np.floor(np.where(valid[:, None], pixels, -1.0) + 0.5).astype(np.int64)
    return rounded[:, 0], rounded[:, 1]


def _under_labels(labels: np.ndarray, view: Frame, margin: float) -> np.ndarray:
    """Return (height, width) bool, True for pixels in the enlarged rectangle of a label."""
    if view.image_size is None:
        return np.zeros((0, 0), dtype=bool)
    width, height = view.image_size
    hidden = np.zeros((height, width), dtype=bool)
    _hide(hidden, image_rectangles(labels, view.calibration, view.image_size), margin)
    return hidden


def _hide(hidden: np.ndarray, rectangles: np.ndarray, margin: float) -> None:
    """Set the pixels in rectangles, enlarged by a share of their sides; NaN ones are left out."""
    for left, top, right, bottom in rectangles[~np.isnan(rectangles).any(axis=1)].tolist():
        wide, tall = margin * (right - left), margin * (bottom - top)
        rows = slice(max(int(top - tall), 0), max(int(bottom + tall) + 1, 0))
        hidden[rows, max(int(left - wide), 0) : max(int(right + wide) + 1, 0)] = True


def _parts(mask: np.ndarray, instances: np.ndarray | None, fewest: int) -> list[np.ndarray]:
    """Return the masks of the instances within a mask, or else of its connected parts.

    Those of fewer pixels are left out.
    """
    import cv2

    if instances is None:
        _, numbers = cv2.connectedComponents(mask.astype(np.uint8))
    else:
        numbers = np.where(mask, instances, 0)
    large = np.flatnonzero(np.bincount(numbers.ravel()) >= fewest)
    return [numbers == number for number in large.tolist() if number]


def _without_overlaps(
    found: Sequence[tuple[np.ndarray, str, int, int, str]], labels: np.ndarray, overlap: float
) -> Proposals:
    """Return the proposals by falling number of points, without those on labels and on others."""
    ordered = sorted(found, key=lambda each: -each[2])
    kept: list[tuple[np.ndarray, str, int, int, str]] = []
    boxes = as_boxes(labels)
    for each in ordered:
        if (bev_iou(each[0][None], boxes) <= overlap).all():
            kept.append(each)
            boxes = np.concatenate([boxes, each[0][None]])
    if not kept:
        return Proposals.empty()
    places, names, points, pixels, cameras = zip(*kept, strict=True)
    return Proposals(
        np.array(places), as_categories(names), np.array(points), np.array(pixels),
        as_categories(cameras),
    )  # fmt: skip
