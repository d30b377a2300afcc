"""2D boxes for objects that have none, from the projection of their 3D boxes.

Tools without images write zeros or -1 for the 2D box of a KITTI object. Its height is then 0, and
no level of KITTI counts it.
"""

from dataclasses import dataclass, replace

import numpy as np

from curate.datasets.kitti.labels import DONT_CARE, KittiObjects
from curate.evaluation.kitti_matching import camera_boxes
from curate.frames import Calibration
from curate.geometry.projection import image_rectangles
from curate.geometry.similarity import wrap_angle
from curate.shapes import Bool, Float

# From the frame of `camera_boxes` (x right, y forward, z up) to the camera frame.
_TO_CAMERA = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_NO_BOX, _OUTSIDE = 0.0, -1.0
# Equal 2D boxes of fewer objects may be chance.
_LEAST_BOXES = 3


@dataclass(frozen=True)
class ProjectedBoxes:
    """The objects of one frame, and how many of their 2D boxes come from the projection.

    Attributes:
        objects: the objects.
        missing: number of objects that had no 2D box.
        projected: number of these that have one now; the others are outside the image, or there is
            no calibration.
    """

    objects: KittiObjects
    missing: int
    projected: int


def without_box(objects: KittiObjects) -> Bool[np.ndarray, " n"]:
    """Return (n,) bool, True for objects with a 2D box without height; DontCare is False."""
    heights = objects.boxes_2d[:, 3] - objects.boxes_2d[:, 1]
    return np.asarray(~(heights > 0) & (objects.categories != DONT_CARE))


def describe_placeholder(boxes_2d: Float[np.ndarray, "n 4"]) -> str:
    """Return that all 2D boxes are the same, and what to do; "" if they differ or are few.

    Converters of data without images write one in place of 2D boxes, for example 0 0 50 50.

    Args:
        boxes_2d: (n, 4) left, top, right, bottom in pixels, of the objects with a height.
    """
    if len(boxes_2d) < _LEAST_BOXES or len(np.unique(boxes_2d, axis=0)) > 1:
        return ""
    shown = " ".join(f"{pixel:g}" for pixel in boxes_2d[0])
    return (
        f"all {len(boxes_2d)} 2D boxes are {shown}, a placeholder: difficulty, image AP and AOS "
        "follow from it; write 0 0 0 0 in its place to use the projected 3D boxes"
    )


def with_projected_boxes(
    objects: KittiObjects,
    projection: Float[np.ndarray, "3 4"] | None,
    image_size: tuple[int, int] | None,
) -> ProjectedBoxes:
    """Return the objects with the projected 3D box as 2D box where they have no 2D box.

    Their observation angle, which tools without images do not know either, also follows from the
    3D box. Objects outside the image get -1 four times. Without projection or image size, missing
    2D boxes become 0 four times.

    Args:
        objects: the objects of one frame.
        projection: (3, 4) rectified camera frame to pixels; None if it is unknown.
        image_size: (width, height) in pixels; None if it is unknown.
    """
    missing = np.flatnonzero(without_box(objects))
    boxes_2d, alpha = objects.boxes_2d.copy(), objects.alpha.copy()
    boxes_2d[missing] = _NO_BOX
    seen = missing[:0]
    if len(missing) and projection is not None and image_size is not None:
        rectangles = image_rectangles(
            camera_boxes(objects)[missing], Calibration(projection, _TO_CAMERA), image_size
        )
        boxes_2d[missing] = np.where(np.isnan(rectangles), _OUTSIDE, rectangles)
        seen = missing[~np.isnan(rectangles[:, 0])]
        x, _, z = objects.locations[seen].T
        alpha[seen] = wrap_angle(objects.rotations_y[seen] - np.arctan2(x, z))
    changed = replace(objects, boxes_2d=boxes_2d, alpha=alpha)
    return ProjectedBoxes(changed, len(missing), len(seen))
