"""KITTI's text format of labels and results, and its conversion to boxes in the LiDAR frame.

Source: the KITTI object development kit (Geiger et al., CVPR 2012), readme.txt. One object per
line: category, truncated, occluded, alpha, left, top, right, bottom (pixels), height, width, length
(metres), x, y, z of the bottom centre in the rectified camera frame (metres), rotation_y (radians),
and in result files a 16th field, the score.

The LiDAR's z axis and the camera's y axis point in opposite directions and differ by less than one
degree. As is usual with KITTI, they are treated as the same axis: yaw = -rotation_y - pi/2. The
bottom centre is raised by half the height along the camera's y axis (which points down), and then
transformed to the LiDAR frame. Example: a car 1.5 m high at (2, 1.7, 20) in the camera frame, which
drives away from the camera, has rotation_y = -pi/2. Its centre is (2, 0.95, 20) in the camera
frame, about (20, -2, -0.95) in the frame of a LiDAR at the camera, and its yaw is 0.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from curate.detections import Annotations, Columns, Detections, as_categories
from curate.errors import DataError
from curate.files.atomic import replace_file
from curate.files.paths import StrPath
from curate.frames import Calibration
from curate.geometry.projection import image_rectangles
from curate.geometry.similarity import wrap_angle
from curate.shapes import Float, Int, Shaped
from curate.spelling import did_you_mean

DONT_CARE = "DontCare"
KITTI_CATEGORIES = frozenset(
    {"Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", DONT_CARE}
)
"""All categories in the label files of KITTI."""

LABEL_FIELDS, RESULT_FIELDS = 15, 16
# Largest accepted absolute value of a field; KITTI's placeholders go down to -1000.
_MAX_VALUE = 1e6


@dataclass(frozen=True)
class KittiObjects(Columns):
    """The lines of one KITTI label or result file, in the frames of reference of that file.

    Attributes:
        categories: (n,) str; "DontCare" marks regions that have only a 2D box.
        truncated: (n,) float64, fraction of the object outside the image, 0 to 1; -1 if unknown.
        occluded: (n,) int64, KITTI's occlusion levels 0 to 3; -1 if unknown.
        alpha: (n,) float64, observation angle in radians.
        boxes_2d: (n, 4) float64: left, top, right, bottom in pixels.
        dimensions: (n, 3) float64: height, width, length in metres.
        locations: (n, 3) float64: bottom centre in the rectified camera frame, in metres.
        rotations_y: (n,) float64: rotation about the camera's y axis, in radians.
        scores: (n,) float64; NaN if the file has no scores.
    """

    categories: Shaped[np.ndarray, " n"]
    truncated: Float[np.ndarray, " n"]
    occluded: Int[np.ndarray, " n"]
    alpha: Float[np.ndarray, " n"]
    boxes_2d: Float[np.ndarray, "n 4"]
    dimensions: Float[np.ndarray, "n 3"]
    locations: Float[np.ndarray, "n 3"]
    rotations_y: Float[np.ndarray, " n"]
    scores: Float[np.ndarray, " n"]

    @classmethod
    def empty(cls) -> Self:
        """Return zero objects."""
        return cls(as_categories([]), *_columns(np.zeros((0, RESULT_FIELDS - 1))))


def read_objects(
    path: StrPath, *, scored: bool = False, categories: Collection[str] | None = KITTI_CATEGORIES
) -> KittiObjects:
    """Return the objects of a KITTI label file, or of a result file if `scored`.

    Label files have 15 fields per line, result files 16. Empty lines are skipped. An empty file
    contains no objects.

    Args:
        path: the text file.
        scored: whether each line ends with a score.
        categories: the allowed category names; None allows any.

    Raises:
        DataError: if the file is missing or not text, or if a line has a wrong number of fields, a
            field that is not a finite number, an unknown category, or a negative dimension (unless
            it is a DontCare region).
    """
    fields = RESULT_FIELDS if scored else LABEL_FIELDS
    path = Path(path)
    lines = _read_lines(path)
    rows = [row for row in map(str.split, lines) if row]
    names = [row[0] for row in rows]
    # All lines are parsed and checked at once for speed; the bad line is searched only on failure.
    try:
        values = np.array([float(field) for row in rows for field in row[1:]])
        values = values.reshape(len(rows), fields - 1)
    except ValueError:  # a field that is not a number, or a wrong number of fields
        raise _first_error(path, lines, fields, categories) from None
    if (
        any(len(row) != fields for row in rows)
        or not (np.abs(values) <= _MAX_VALUE).all()
        or (categories is not None and not frozenset(categories).issuperset(names))
        or _has_negative_dimension(names, values[:, 7:10])
    ):
        raise _first_error(path, lines, fields, categories)
    return KittiObjects(as_categories(names), *_columns(values))


def write_objects(path: StrPath, objects: KittiObjects) -> None:
    """Write a label file atomically, or a result file if the objects have scores.

    The files of KITTI have two decimals. This function writes four decimals for alpha, dimensions,
    location and rotation_y, so that a box is read back within 0.1 mm per coordinate; six for the
    score; and two for truncation and the 2D box.

    Raises:
        DataError: if a number is not finite, or only some objects have scores.
    """
    path = Path(path)
    scored = ~np.isnan(objects.scores)
    if scored.any() and not scored.all():
        raise DataError(f"{path}: {np.sum(~scored)} of {len(scored)} objects have no score")
    lines = [
        _format(objects, index) + (f" {objects.scores[index]:.6f}" if scored[index] else "")
        for index in range(len(objects))
    ]
    for number, line in enumerate(lines, start=1):
        if "nan" in line or "inf" in line:
            raise DataError(f"{path}:{number}: cannot write numbers that are not finite: {line}")
    replace_file(path, "".join(f"{line}\n" for line in lines).encode())


def to_annotations(objects: KittiObjects, calibration: Calibration) -> Annotations:
    """Return the objects as ground truth in the LiDAR frame; boxes of DontCare regions are NaN."""
    boxes = _boxes_lidar(objects, calibration)
    boxes[objects.categories == DONT_CARE] = np.nan
    return Annotations(
        boxes,
        objects.categories,
        objects.truncated,
        objects.occluded,
        objects.alpha,
        objects.boxes_2d,
    )


def to_detections(objects: KittiObjects, calibration: Calibration) -> Detections:
    """Return the objects as detections in the LiDAR frame, without DontCare regions."""
    kept = objects.select(objects.categories != DONT_CARE)
    return Detections(_boxes_lidar(kept, calibration), kept.scores, kept.categories)


def from_annotations(annotations: Annotations, calibration: Calibration) -> KittiObjects:
    """Return ground truth as KITTI objects, the inverse of `to_annotations`.

    DontCare regions get KITTI's placeholders: dimensions -1, location -1000, rotation_y -10.
    """
    dimensions, locations, rotations_y = _boxes_camera(annotations.boxes, calibration)
    region = annotations.categories == DONT_CARE
    dimensions[region], locations[region], rotations_y[region] = -1, -1000, -10
    return KittiObjects(
        annotations.categories,
        annotations.truncated,
        annotations.occluded,
        annotations.alpha,
        annotations.boxes_2d,
        dimensions,
        locations,
        rotations_y,
        np.full(len(annotations), np.nan),
    )


def from_detections(
    detections: Detections, calibration: Calibration, image_size: tuple[int, int]
) -> KittiObjects:
    """Return detections as KITTI objects, in the same order.

    The 2D box is the projected 3D box, clipped to the image. A box outside the image gets (-1, -1,
    -1, -1); its height is 0, so KITTI's evaluation ignores it. Truncation and occlusion are unknown
    (-1).

    Args:
        detections: boxes in the LiDAR frame.
        calibration: calibration of the frame.
        image_size: (width, height) of the image in pixels.
    """
    dimensions, locations, rotations_y = _boxes_camera(detections.boxes, calibration)
    boxes_2d = image_rectangles(detections.boxes, calibration, image_size)
    count = len(detections)
    return KittiObjects(
        detections.categories,
        np.full(count, -1.0),
        np.full(count, -1, dtype=np.int64),
        wrap_angle(rotations_y - np.arctan2(locations[:, 0], locations[:, 2])),
        np.where(np.isnan(boxes_2d), -1.0, boxes_2d),
        dimensions,
        locations,
        rotations_y,
        detections.scores,
    )


def _boxes_lidar(objects: KittiObjects, calibration: Calibration) -> np.ndarray:
    """Return the (n, 7) boxes in the LiDAR frame."""
    height, width, length = objects.dimensions.T
    centres = objects.locations.copy()
    centres[:, 1] -= height / 2  # the camera's y points down
    to_lidar = np.linalg.inv(calibration.lidar_to_camera)
    return np.column_stack(
        [
            centres @ to_lidar[:3, :3].T + to_lidar[:3, 3],
            length,
            width,
            height,
            wrap_angle(-objects.rotations_y - np.pi / 2),
        ]
    )


def _boxes_camera(
    boxes: np.ndarray, calibration: Calibration
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (n, 3) height, width, length; (n, 3) bottom centres; (n,) rotation_y, as in KITTI."""
    to_camera = calibration.lidar_to_camera
    locations = boxes[:, :3] @ to_camera[:3, :3].T + to_camera[:3, 3]
    locations[:, 1] += boxes[:, 5] / 2
    return boxes[:, [5, 4, 3]], locations, wrap_angle(-boxes[:, 6] - np.pi / 2)


def _columns(values: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the fields of `KittiObjects` after the categories, from (n, 14) or (n, 15) numbers."""
    scores = values[:, 14] if values.shape[1] > 14 else np.full(len(values), np.nan)
    return (
        values[:, 0],
        values[:, 1].astype(np.int64),
        values[:, 2],
        values[:, 3:7],
        values[:, 7:10],
        values[:, 10:13],
        values[:, 13],
        scores,
    )


def _format(objects: KittiObjects, index: int) -> str:
    """Return the label line of one object, without the score."""
    category = objects.categories[index]
    box_2d = " ".join(f"{pixel:.2f}" for pixel in objects.boxes_2d[index])
    if category == DONT_CARE:
        return f"{DONT_CARE} -1 -1 -10 {box_2d} -1 -1 -1 -1000 -1000 -1000 -10"
    shape = (*objects.dimensions[index], *objects.locations[index], objects.rotations_y[index])
    return (
        f"{category} {objects.truncated[index]:.2f} {objects.occluded[index]} "
        f"{objects.alpha[index]:.4f} {box_2d} {' '.join(f'{number:.4f}' for number in shape)}"
    )


def _read_lines(path: Path) -> list[str]:
    try:
        return path.read_bytes().decode("utf-8-sig").splitlines()
    except FileNotFoundError:
        raise DataError(f"{path}: no such label file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a text file (byte {error.start})") from error


def _has_negative_dimension(categories: Sequence[str], dimensions: np.ndarray) -> bool:
    """Return whether an object other than a DontCare region has a negative dimension."""
    if dimensions.min(initial=0) >= 0:
        return False
    rows = np.flatnonzero((dimensions < 0).any(axis=1)).tolist()
    return any(categories[row] != DONT_CARE for row in rows)


def _first_error(
    path: Path, lines: Sequence[str], fields: int, categories: Collection[str] | None
) -> DataError:
    """Return the error for the first invalid line of a file with at least one."""
    rows = [(number, line.split()) for number, line in enumerate(lines, start=1)]
    problems = ((number, _line_problem(row, fields, categories)) for number, row in rows if row)
    number, problem = next((number, problem) for number, problem in problems if problem)
    return DataError(f"{path}:{number}: {problem}")


def _line_problem(
    row: Sequence[str], fields: int, categories: Collection[str] | None
) -> str | None:
    """Return what is wrong with one line, or None."""
    if len(row) != fields:
        kind = "result lines (which end with a score)" if fields == RESULT_FIELDS else "label lines"
        return f"{len(row)} fields, but {kind} have {fields}"
    if categories is not None and row[0] not in categories:
        meant = did_you_mean(row[0], categories)
        return (
            f"unknown category {row[0][:40]!r}; use one of {', '.join(sorted(categories))}{meant}"
        )
    problem = next(filter(None, map(_number_problem, row[1:])), None)
    if problem:
        return problem
    if row[0] != DONT_CARE and min(map(float, row[8:11])) < 0:
        return f"negative height, width or length ({' '.join(row[8:11])}) of a {row[0]}"
    return None


def _number_problem(field: str) -> str | None:
    """Return what is wrong with a field that must be a number, or None."""
    try:
        number = float(field)
    except ValueError:
        return f"{field[:40]!r} is not a number"
    if not np.isfinite(number):
        return f"{field[:40]!r} is not a finite number"
    if abs(number) > _MAX_VALUE:
        return f"{field[:40]!r} is beyond {_MAX_VALUE:g}, the largest valid number in a label"
    return None
