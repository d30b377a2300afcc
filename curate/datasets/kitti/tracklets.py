"""Reader of tracklet_labels.xml, the labels of KITTI's raw recordings.

Source: the development kit of KITTI's raw data (Geiger et al., IJRR 2013), readme.txt. A tracklet
is an object with its category (objectType), its size (h, w, l in metres), the number of its first
frame, and one pose per frame from there on. A pose is the bottom centre of the box in the LiDAR
frame (tx, ty, tz in metres), its rotation (rz about the z axis; rx and ry are 0), and states:

| field | values |
|---|---|
| occlusion | -1 not set, 0 visible, 1 partly, 2 fully occluded |
| truncation | -1, 99, 255 not set, 0 in the image, 1 truncated, 2 outside, 3 behind the camera |
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

import numpy as np

from curate.datasets.formats.binary import read_bytes
from curate.datasets.image_truth import seen_objects
from curate.detections import Annotations, as_categories
from curate.errors import DataError
from curate.frames import Frame
from curate.geometry.mounting import observation_angles
from curate.geometry.projection import image_rectangles
from curate.geometry.similarity import wrap_angle

TRACKLETS = "tracklet_labels.xml"
# The name of the object data set for a category of the raw recordings.
_CATEGORIES = {"Person (sitting)": "Person_sitting"}
_OUTSIDE = (2, 3)
_MAX_DEPTH = 16
_MAX_NUMBER = 1e6
_UPRIGHT_RAD = 0.01


@dataclass(frozen=True)
class _Pose:
    """The box of a tracklet in one frame: category, (7,) box, occlusion, truncation state."""

    category: str
    box: tuple[float, ...]
    occlusion: int
    truncation: int


class TrackletTable:
    """The objects of a drive by the number of the frame.

    Args:
        path: tracklet_labels.xml.

    Raises:
        DataError: if the file is missing, not XML, declares entities, or a tracklet is malformed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._frames = _poses_by_frame(path)

    def read(self, number: int, frame: Frame) -> Annotations:
        """Return the objects in the camera's view, in the LiDAR frame, in the file's order.

        The file has no 2D boxes: these, and truncation and alpha, follow from the projection.
        Objects with the state "outside" or "behind" (of the image) are left out, too. Without a
        camera, all objects are returned.

        Args:
            number: number of the frame in the drive, from 0.
            frame: the frame with its camera.
        """
        poses = self._frames.get(number, [])
        if frame.cameras:
            poses = [pose for pose in poses if pose.truncation not in _OUTSIDE]
        boxes = np.array([pose.box for pose in poses]).reshape(-1, 7)
        categories = as_categories([pose.category for pose in poses])
        occluded = np.array([pose.occlusion for pose in poses], dtype=np.int64)
        if frame.cameras:
            return seen_objects(boxes, categories, occluded, frame.cameras)
        return Annotations(
            boxes,
            categories,
            np.zeros(len(boxes)),
            occluded,
            observation_angles(boxes, frame.calibration),
            image_rectangles(boxes, frame.calibration, None),
        )


def _poses_by_frame(path: Path) -> Mapping[int, list[_Pose]]:
    """Return the poses of all tracklets by the number of the frame."""
    frames: dict[int, list[_Pose]] = {}
    root = _parse(path)
    tracklets = [item for each in root.every("tracklets") for item in each.every("item")]
    for tracklet in tracklets:
        category = tracklet.text(path, "objectType")
        height, width, length = (tracklet.number(path, side) for side in "hwl")
        if min(height, width, length) <= 0:
            raise DataError(
                f"{path}:{tracklet.line}: size of {height:g} x {width:g} x {length:g} m of a "
                f"{category}; h, w and l must be above 0"
            )
        first = int(tracklet.number(path, "first_frame"))
        poses = [item for each in tracklet.every("poses") for item in each.every("item")]
        for number, pose in enumerate(poses, start=first):
            x, y, bottom, yaw = (pose.number(path, key) for key in ("tx", "ty", "tz", "rz"))
            tilts = np.array([pose.number(path, key, 0) for key in ("rx", "ry")])
            if np.abs(wrap_angle(tilts)).max() > _UPRIGHT_RAD:
                raise DataError(
                    f"{path}:{pose.line}: rotated about x or y; only rotation about z is supported"
                )
            box = (
                x,
                y,
                bottom + height / 2,
                length,
                width,
                height,
                float(wrap_angle(np.array(yaw))),
            )
            found = _Pose(
                _CATEGORIES.get(category, category),
                box,
                _occlusion(pose.number(path, "occlusion", -1)),
                int(pose.number(path, "truncation", -1)),
            )
            frames.setdefault(number, []).append(found)
    return frames


def _occlusion(state: float) -> int:
    """Return KITTI's occlusion level; 3 (unknown) if it is not set."""
    return int(state) if state in (0, 1, 2) else 3


class _Node:
    """An XML element with the line where it begins, its text and its children."""

    def __init__(self, tag: str, line: int) -> None:
        self.tag = tag
        self.line = line
        self.parts: list[str] = []
        self.children: list[_Node] = []

    def every(self, tag: str) -> "list[_Node]":
        """Return the children with a tag."""
        return [child for child in self.children if child.tag == tag]

    def text(self, path: Path, tag: str) -> str:
        """Return the text of the only child with a tag."""
        found = self.every(tag)
        text = "".join(found[0].parts).strip() if len(found) == 1 else ""
        if not text:
            raise DataError(f"{path}:{self.line}: <{self.tag}> must have one <{tag}> with a value")
        return text

    def number(self, path: Path, tag: str, default: float | None = None) -> float:
        """Return the number in the only child with a tag; the default if there is none."""
        if default is not None and not self.every(tag):
            return default
        text = self.text(path, tag)
        try:
            number = float(text)
        except ValueError:
            number = np.nan
        if not abs(number) <= _MAX_NUMBER:
            raise DataError(f"{path}:{self.line}: <{tag}> is {text[:40]!r}, not a valid number")
        return number


def _parse(path: Path) -> _Node:
    """Return the document as a node with the root element as its child's children.

    Entities are rejected: a few lines of them can expand to gigabytes.
    """
    top = _Node("", 1)
    stack = [top]
    parser = expat.ParserCreate()

    def start(tag: str, _attributes: object) -> None:
        if len(stack) > _MAX_DEPTH:
            raise DataError(f"{path}:{parser.CurrentLineNumber}: too many nested elements")
        node = _Node(tag, parser.CurrentLineNumber)
        stack[-1].children.append(node)
        stack.append(node)

    def reject(*_arguments: object) -> None:
        raise DataError(f"{path}:{parser.CurrentLineNumber}: declares an entity; remove it")

    def add_text(text: str) -> None:
        stack[-1].parts.append(text)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _tag: stack.pop()
    parser.CharacterDataHandler = add_text
    parser.EntityDeclHandler = reject
    try:
        parser.Parse(read_bytes(path, "tracklet"), True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise DataError(f"{path}: not XML: {error}") from None
    (root,) = top.children
    if root.tag != "boost_serialization" or not root.every("tracklets"):
        raise DataError(f"{path}: no <boost_serialization> with <tracklets>; is it KITTI's file?")
    return root
