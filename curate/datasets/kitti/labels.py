"""KITTI's text format of labels and results, and its conversion to boxes in the LiDAR frame.

Source: the KITTI object development kit (Geiger et al., CVPR 2012), readme.txt. One object per
line: category, truncated, occluded, alpha, left, top, right, bottom (pixels), height, width, length
(metres), x, y, z of the bottom centre in the rectified camera frame (metres), rotation_y (radians),
and in result files a 16th field, the score.

An object stands upright in the LiDAR frame, on its bottom centre, which the calibration carries
from the camera frame into the LiDAR frame. The box centre is half the height above it, along the
LiDAR's z axis, whichever way the camera is tilted. `curate.geometry.mounting` defines the heading.
Example: a car 1.5 m high at (2, 1.7, 20) in the camera frame, which drives away from the camera,
has rotation_y -pi/2. If a level camera is at the LiDAR's origin, the car stands at (20, -2, -1.7),
its centre is (20, -2, -0.95), and its yaw is 0.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self

import numpy as np

from curate.detections import Annotations, Columns, Detections, as_categories
from curate.errors import DataError, error_prefix
from curate.files.atomic import replace_file
from curate.files.paths import StrPath
from curate.files.text import read_lines
from curate.frames import Calibration, RotationY
from curate.geometry.mounting import (
    bottom_centres_in_camera,
    observation_angles,
    rotations_y_of_yaws,
    yaws_of_rotations_y,
)
from curate.geometry.projection import image_rectangles
from curate.shapes import Float, Int, Shaped
from curate.spelling import did_you_mean
from curate.warnings_once import warn_once

DONT_CARE = "DontCare"
KITTI_CATEGORIES = frozenset(
    {"Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", DONT_CARE}
)
"""All categories in the label files of KITTI."""

LABEL_FIELDS, RESULT_FIELDS = 15, 16
# "x y z dx dy dz heading name" of OpenPCDet's custom data sets.
_CUSTOM_FIELDS = 8
# Largest accepted absolute value of a field; KITTI's placeholders go down to -1000.
_MAX_VALUE = 1e6
# Numbers of a line: truncated, occluded, alpha, 2D box, shape, score.
_OBJECT_LINE = "%s %.2f %d %.4f" + " %.2f" * 4 + " %.4f" * 7
_REGION_LINE = "%s %d %d %d" + " %.2f" * 4 + " %d" * 7
_SCORE = " %.6f"
_REGION = (-1, -1, -10, 0, 0, 0, 0, -1, -1, -1, -1000, -1000, -1000, -10, 0)
# Locations that mean "unknown": KITTI's placeholder, and the camera itself.
_NO_LOCATION = ((-1000.0, -1000.0, -1000.0), (0.0, 0.0, 0.0))
_WITHOUT_3D = (
    f"delete the line, or set its category to {DONT_CARE} to keep its 2D box as a region that is "
    "neither object nor background"
)


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

    Every reader of KITTI's format uses this function. Label files have 15 fields per line; a 16th,
    which some converters write, is left out. Result files have 16. Empty lines are skipped. An
    empty file contains no objects.

    Args:
        path: the text file.
        scored: whether each line ends with a score.
        categories: the allowed category names; None allows any.

    Raises:
        DataError: if the file is missing or not text, or if a line has a wrong number of fields, a
            field that is not a finite number, an unknown category, or a size that is not positive
            (unless it is a DontCare region), or if a label file has an object twice.
    """
    path = Path(path)
    return parse_rows(path, read_rows(path), scored=scored, categories=categories)


def parse_rows(
    path: Path,
    numbered: Sequence[tuple[int, Sequence[str]]],
    *,
    scored: bool = False,
    categories: Collection[str] | None = KITTI_CATEGORIES,
) -> KittiObjects:
    """Return the objects of lines in KITTI's format, which are split into fields.

    Args:
        path: the file, for error messages.
        numbered: line number and fields of each object.
        scored: see `read_objects`.
        categories: see `read_objects`.

    Raises:
        DataError: as `read_objects`.
    """
    fields = RESULT_FIELDS if scored else LABEL_FIELDS
    rows = [row[:fields] for _, row in numbered]
    names = [row[0] for row in rows]
    # All lines are parsed and checked at once for speed; the bad line is searched only on failure.
    try:
        values = np.array([float(field) for row in rows for field in row[1:]])
        values = values.reshape(len(rows), fields - 1)
    except ValueError:  # a field that is not a number, or a wrong number of fields
        raise _first_error(path, numbered, categories, scored=scored) from None
    if (
        any(not fields <= len(row) <= RESULT_FIELDS for _, row in numbered)
        or not (np.abs(values) <= _MAX_VALUE).all()
        or (categories is not None and not frozenset(categories).issuperset(names))
        or _has_no_box(names, values[:, 7:13])
    ):
        raise _first_error(path, numbered, categories, scored=scored)
    if not scored:
        _check_repeated(path, numbered)
    return KittiObjects(as_categories(names), *_columns(values))


def read_rows(path: Path) -> list[tuple[int, list[str]]]:
    """Return line number and fields of each line of a label or result file that is not empty.

    Raises:
        DataError: if the file is missing or not text.
    """
    lines = enumerate(read_lines(path, "label"), start=1)
    return [(number, row) for number, line in lines if (row := line.split())]


def write_objects(path: StrPath, objects: KittiObjects) -> None:
    """Write a label file atomically, or a result file if the objects have scores.

    The files of KITTI have two decimals. This function writes four decimals for alpha, dimensions,
    location and rotation_y, so that a box is read back within 0.1 mm per coordinate; six for the
    score; and two for truncation and the 2D box.

    Raises:
        DataError: if a number is not finite, or only some objects have scores.
    """
    path = Path(path)
    replace_file(path, format_objects(path, objects))


def format_objects(path: Path, objects: KittiObjects) -> bytes:
    """Return the content of a label or result file; see `write_objects`.

    Args:
        path: the file, for messages.
        objects: its objects.

    Raises:
        DataError: if a number is not finite, or only some objects have scores.
    """
    scored = ~np.isnan(objects.scores)
    if scored.any() and not scored.all():
        raise DataError(f"{path}: {np.sum(~scored)} of {len(scored)} objects have no score")
    region = objects.categories == DONT_CARE
    numbers = np.column_stack(
        [getattr(objects, column.name) for column in fields(objects) if column.name != "categories"]
    )
    numbers[region] = _REGION
    numbers[region, 3:7], numbers[region, 14] = objects.boxes_2d[region], objects.scores[region]
    last = 15 if scored.any() else 14
    finite = np.isfinite(numbers[:, :last]).all(axis=1)
    forms = [form + _SCORE * (last == 15) for form in (_OBJECT_LINE, _REGION_LINE)]
    rows = zip(
        region.tolist(), objects.categories.tolist(), numbers[:, :last].tolist(), strict=True
    )
    lines = [forms[is_region] % (category, *row) for is_region, category, row in rows]
    if not finite.all():
        number = int(np.argmin(finite))
        raise DataError(
            f"{path}:{number + 1}: cannot write numbers that are not finite: {lines[number]}"
        )
    return "".join(f"{line}\n" for line in lines).encode()


def read_annotations(
    path: StrPath,
    calibration: Calibration,
    *,
    categories: Collection[str] | None = KITTI_CATEGORIES,
) -> Annotations:
    """Return the ground truth of a label file; see `read_objects` and `to_annotations`.

    Raises:
        DataError: if the file is missing or malformed, or the mounting of the camera does not
            define the headings.
    """
    objects = read_objects(path, categories=categories)
    with error_prefix(str(path)):
        return to_annotations(objects, calibration)


def to_annotations(
    objects: KittiObjects, calibration: Calibration, rotation_y: RotationY | None = None
) -> Annotations:
    """Return the objects as ground truth in the LiDAR frame; boxes of DontCare regions are NaN.

    Args:
        objects: objects in the camera frame.
        calibration: calibration of the frame.
        rotation_y: the meaning of rotation_y; None for that of the data set.

    Raises:
        DataError: if the mounting of the camera does not define the headings.
    """
    boxes = _boxes_lidar(objects, calibration, rotation_y)
    boxes[objects.categories == DONT_CARE] = np.nan
    return Annotations(
        boxes,
        objects.categories,
        objects.truncated,
        objects.occluded,
        objects.alpha,
        objects.boxes_2d,
    )


def to_detections(
    objects: KittiObjects, calibration: Calibration, rotation_y: RotationY | None = None
) -> Detections:
    """Return the objects as detections in the LiDAR frame, without DontCare regions.

    Arguments and errors are those of `to_annotations`.
    """
    kept = objects.select(objects.categories != DONT_CARE)
    return Detections(_boxes_lidar(kept, calibration, rotation_y), kept.scores, kept.categories)


def from_annotations(annotations: Annotations, calibration: Calibration) -> KittiObjects:
    """Return ground truth as KITTI objects, the inverse of `to_annotations`.

    DontCare regions get KITTI's placeholders: dimensions -1, location -1000, rotation_y -10.

    Raises:
        DataError: if the mounting of the camera does not define the headings.
    """
    dimensions, locations, rotations_y = _boxes_camera(annotations.boxes, calibration, None)
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
    detections: Detections,
    calibration: Calibration,
    image_size: tuple[int, int] | None,
    rotation_y: RotationY | None = None,
) -> KittiObjects:
    """Return detections as KITTI objects, in the same order.

    The 2D box is the projected 3D box, clipped to the image. A box outside the image gets (-1, -1,
    -1, -1); its height is 0, so KITTI's evaluation ignores it. Without a camera, 2D boxes are 0.
    Truncation and occlusion are unknown (-1).

    Args:
        detections: boxes in the LiDAR frame.
        calibration: calibration of the frame.
        image_size: (width, height) of the image in pixels; None if there is no image, so that
            nothing is clipped.
        rotation_y: the meaning of rotation_y; None for that of the data set. alpha follows the
            calibration in any case.

    Raises:
        DataError: if the mounting of the camera does not define the headings.
    """
    dimensions, locations, rotations_y = _boxes_camera(detections.boxes, calibration, rotation_y)
    count = len(detections)
    boxes_2d = np.zeros((count, 4))
    if calibration.has_camera:
        boxes_2d = image_rectangles(detections.boxes, calibration, image_size)
    return KittiObjects(
        detections.categories,
        np.full(count, -1.0),
        np.full(count, -1, dtype=np.int64),
        observation_angles(detections.boxes, calibration),
        np.where(np.isnan(boxes_2d), -1.0, boxes_2d),
        dimensions,
        locations,
        rotations_y,
        detections.scores,
    )


def _boxes_lidar(
    objects: KittiObjects, calibration: Calibration, rotation_y: RotationY | None
) -> np.ndarray:
    """Return the (n, 7) boxes in the LiDAR frame."""
    height, width, length = objects.dimensions.T
    to_lidar = np.linalg.inv(calibration.lidar_to_camera)
    centres = objects.locations @ to_lidar[:3, :3].T + to_lidar[:3, 3]
    centres[:, 2] += height / 2
    yaws = yaws_of_rotations_y(objects.rotations_y, calibration, rotation_y)
    return np.column_stack([centres, length, width, height, yaws])


def _boxes_camera(
    boxes: np.ndarray, calibration: Calibration, rotation_y: RotationY | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (n, 3) height, width, length; (n, 3) bottom centres; (n,) rotation_y, as in KITTI."""
    return (
        boxes[:, [5, 4, 3]],
        bottom_centres_in_camera(boxes, calibration),
        rotations_y_of_yaws(boxes[:, 6], calibration, rotation_y),
    )


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


def _check_repeated(path: Path, numbered: Sequence[tuple[int, Sequence[str]]]) -> None:
    """Raise DataError if a label file was written twice; warn about single repeated objects.

    In an evaluation, one of two equal objects is always missed.
    """
    first: dict[tuple[str, ...], int] = {}
    repeated = ""
    objects = 0
    for number, row in numbered:
        if row[0] == DONT_CARE:
            continue
        objects += 1
        earlier = first.setdefault((row[0], *row[8:LABEL_FIELDS]), number)
        if earlier != number and not repeated:
            repeated = f"{path}:{number}: the {row[0]} has the same 3D box as in line {earlier}"
    if repeated and 2 * len(first) <= objects:
        raise DataError(f"{repeated}, and so on: the file was written twice; keep one half")
    if repeated:
        warn_once(f"{repeated}; remove one of them, because it counts twice as a missed object")


def _has_no_box(categories: Sequence[str], shapes: np.ndarray) -> bool:
    """Return whether an object other than a DontCare region has no 3D box, see `_box_problem`.

    Args:
        categories: n names.
        shapes: (n, 6) height, width, length and location.
    """
    invalid = (shapes[:, :3] <= 0).any(axis=1)
    for location in _NO_LOCATION:
        invalid |= (shapes[:, 3:] == location).all(axis=1)
    return any(categories[row] != DONT_CARE for row in np.flatnonzero(invalid).tolist())


def _first_error(
    path: Path,
    rows: Iterable[tuple[int, Sequence[str]]],
    categories: Collection[str] | None,
    *,
    scored: bool,
) -> DataError:
    """Return the error for the first invalid line of a file with at least one."""
    problems = ((number, _line_problem(row, categories, scored=scored)) for number, row in rows)
    number, problem = next((number, problem) for number, problem in problems if problem)
    return DataError(f"{path}:{number}: {problem}")


def _line_problem(
    row: Sequence[str], categories: Collection[str] | None, *, scored: bool
) -> str | None:
    """Return what is wrong with one line, or None."""
    if len(row) == LABEL_FIELDS and scored:
        return "15 fields: the score is missing; result lines end with it as the 16th field"
    if not LABEL_FIELDS <= len(row) <= RESULT_FIELDS:
        expected_fields = RESULT_FIELDS if scored else LABEL_FIELDS
        expected = "result lines have 16" if scored else "label lines have 15, or 16 with a score"
        if len(row) == _CUSTOM_FIELDS and not _number_problem(row[0]):
            expected += (
                '; "x y z dx dy dz heading name" of OpenPCDet is in the LiDAR frame, and must be '
                'converted (docs/datasets.md, "Boxes in the LiDAR frame")'
            )
        return f"{len(row)} fields, but {expected}{_extra_fields(row, expected_fields)}"
    if categories is not None and row[0] not in categories:
        meant = did_you_mean(row[0], categories)
        return (
            f"unknown category {row[0][:40]!r}; use one of {', '.join(sorted(categories))}{meant}"
        )
    fields = RESULT_FIELDS if scored else LABEL_FIELDS
    problem = next(filter(None, map(_number_problem, row[1:fields])), None)
    return problem or _box_problem(row)


def _extra_fields(row: Sequence[str], expected: int) -> str:
    """Return where the expected fields are in a line with more fields, and what to do.

    Tracking lines begin with the frame and the track; converters append ids, dates or counts. "" if
    the line has neither form.
    """
    if _begins_like_kitti(row[2:]) and all(field.lstrip("-").isdigit() for field in row[:2]):
        return (
            f"; it begins with the frame and the track, as in KITTI tracking: keep fields 3 to "
            f"{expected + 2}, in a file per frame"
        )
    if _begins_like_kitti(row):
        return f"; keep the first {expected}, without {' '.join(row[expected:])[:60]}"
    return ""


def _begins_like_kitti(row: Sequence[str]) -> bool:
    """Return whether a line begins with a category and the 14 numbers of KITTI's format."""
    numbers = row[1:LABEL_FIELDS]
    return (
        len(numbers) == LABEL_FIELDS - 1
        and _number_problem(row[0]) is not None
        and not any(map(_number_problem, numbers))
    )


def _box_problem(row: Sequence[str]) -> str | None:
    """Return what is wrong with the size and location of the 3D box of a line, or None."""
    sizes = [float(field) for field in row[8:11]]
    if row[0] == DONT_CARE:
        return None
    location = tuple(float(field) for field in row[11:14])
    if min(sizes) > 0 and location not in _NO_LOCATION:
        return None
    if min(sizes) > 0:
        return f"no 3D box: the {row[0]} is at {' '.join(row[11:14])}; {_WITHOUT_3D}"
    shown = f"height, width and length of the {row[0]} are {' '.join(row[8:11])}"
    if max(sizes) <= 0:
        return f"no 3D box: {shown}; {_WITHOUT_3D}"
    return f"{shown}, but must be positive"


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
