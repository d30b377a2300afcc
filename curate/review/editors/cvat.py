"""CVAT's 3D tasks: point clouds with their images as a task, cuboids as "Datumaro 3D 1.0".

Source: CVAT's documentation, "Data formats for a 3D task" (pointcloud/NAME.pcd with
related_images/NAME_pcd/) and its list of 3D formats; Datumaro's JSON (annotations/SUBSET.json):
categories.label.labels, and items whose annotations of type cuboid_3d hold label_id, position,
rotation (Euler angles, radians) and scale (the sides along the box's own x, y and z). CVAT finds
the frame of an item by its id, the name of the point file without its ending.

task.zip creates the task, labels.json goes into its tab Raw, annotations.zip is uploaded to it. The
export of CVAT as "Datumaro 3D 1.0" contains the edits: save it as annotations.zip, or pass its path
with `--answer`.
"""

import io
import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np

from curate.errors import DataError
from curate.files.json_text import parse_json
from curate.frames import Frame
from curate.geometry.similarity import wrap_angle
from curate.review.editors.base import Reader
from curate.review.editors.documents import numbers, write_json
from curate.review.editors.names import match_frame_names
from curate.review.edits import EditedBox
from curate.review.sheet import Sheet, ShownFrame

ANNOTATIONS = "annotations.zip"
_MEMBER = "annotations/default.json"
_LARGEST_BYTES = 2**28
_UPRIGHT_RADIANS = 0.01
# Datumaro's media type "point cloud"; without it Datumaro takes every item for an image and fails.
_POINT_CLOUD = 6


class CvatEditor:
    """An `Editor` of CVAT's 3D tasks."""

    name: ClassVar[str] = "cvat"

    def write(self, folder: Path, sheet: Sheet, read: Reader) -> None:
        """See `curate.review.editors.base.Editor`."""
        labels = [{"name": name, "type": "cuboid", "attributes": []} for name in sheet.categories]
        write_json(folder / "labels.json", labels)
        with zipfile.ZipFile(folder / "task.zip", "w", zipfile.ZIP_DEFLATED) as task:
            for shown in sheet.frames:
                _add_frame(task, shown.frame, read(shown.frame))
        with zipfile.ZipFile(folder / ANNOTATIONS, "w", zipfile.ZIP_DEFLATED) as annotations:
            annotations.writestr(_MEMBER, json.dumps(_document(sheet)))

    def read(
        self,
        edited: Path,
        sheet: Sheet,
        read: Reader,  # noqa: ARG002 - its boxes are in the LiDAR frame
    ) -> Mapping[str, Sequence[EditedBox]]:
        """See `curate.review.editors.base.Editor`."""
        path = edited / ANNOTATIONS if edited.is_dir() else edited
        found: dict[str, list[EditedBox]] = {}
        for document, place in _documents(path):
            names = _label_names(document, place)
            for item in document["items"]:
                name = str(item.get("id"))
                boxes = found.setdefault(name, [])
                for i, each in enumerate(item.get("annotations") or (), start=1):
                    boxes += _read_cuboid(each, names, f"{place}: frame {name}, annotation {i}")
        frames = match_frame_names(path, found, sheet)
        return {frame: found[name] for name, frame in frames.items()}


def pcd_bytes(points: np.ndarray) -> bytes:
    """Return (n, 4) float32 x, y, z, intensity as the bytes of a binary PCD 0.7 file."""
    count = len(points)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity\n"
        "SIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    )
    return header.encode() + points[:, :4].astype("<f4").tobytes()


def _add_frame(task: zipfile.ZipFile, name: str, frame: Frame) -> None:
    task.writestr(f"pointcloud/{name}.pcd", pcd_bytes(frame.points))
    if frame.image is not None:
        _, content = cv2.imencode(".png", cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
        task.writestr(f"related_images/{name}_pcd/{name}.png", content.tobytes())


def _document(sheet: Sheet) -> dict[str, Any]:
    labels = [{"name": name, "parent": "", "attributes": []} for name in sheet.categories]
    return {
        "info": {},
        "media_type": _POINT_CLOUD,
        "categories": {"label": {"labels": labels, "attributes": ["occluded"]}},
        "items": [_item(sheet, i, shown) for i, shown in enumerate(sheet.frames)],
    }


def _item(sheet: Sheet, number: int, shown: ShownFrame) -> dict[str, Any]:
    annotations = [
        {
            "id": i,
            "type": "cuboid_3d",
            "attributes": {"occluded": False},
            "group": 0,
            "label_id": sheet.categories.index(box.category),
            "position": list(box.box[:3]),
            "rotation": [0.0, 0.0, box.box[6]],
            "scale": list(box.box[3:6]),
        }
        for i, box in enumerate(shown.boxes)
    ]
    return {
        "id": shown.frame,
        "annotations": annotations,
        "attr": {"frame": number},
        "point_cloud": {"path": f"{shown.frame}.pcd"},
    }


def _documents(path: Path) -> Iterator[tuple[Mapping[str, Any], str]]:
    """Yield the Datumaro documents of a file, each with its place for messages.

    Raises:
        DataError: if the file is missing, damaged, too large, or has no document.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file; export the task from CVAT as Datumaro 3D 1.0")
    content = path.read_bytes()
    if not zipfile.is_zipfile(io.BytesIO(content)):
        yield _parsed(content, str(path)), str(path)
        return
    found = False
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for member in archive.infolist():
            if member.filename.startswith("annotations/") and member.filename.endswith(".json"):
                place = f"{path}: {member.filename}"
                if member.file_size > _LARGEST_BYTES:
                    raise DataError(
                        f"{place}: {member.file_size} bytes; at most {_LARGEST_BYTES} are read"
                    )
                try:
                    yield _parsed(archive.read(member), place), place
                except (zipfile.BadZipFile, RuntimeError, OSError) as error:
                    raise DataError(f"{place}: damaged ({error}); export it again") from None
                found = True
    if not found:
        raise DataError(f"{path}: has no annotations/*.json; export it as Datumaro 3D 1.0")


def _parsed(content: bytes, place: str) -> Mapping[str, Any]:
    document = parse_json(content, place)
    if (
        not isinstance(document, Mapping)
        or not isinstance(document.get("items"), list)
        or not all(isinstance(item, Mapping) for item in document["items"])
    ):
        raise DataError(f"{place}: has no list of items; export it from CVAT as Datumaro 3D 1.0")
    return document


def _label_names(document: Mapping[str, Any], place: str) -> list[str]:
    try:
        return [str(label["name"]) for label in document["categories"]["label"]["labels"]]
    except (KeyError, TypeError):
        raise DataError(f"{place}: lists no labels; export it from CVAT as Datumaro 3D") from None


def _read_cuboid(each: Any, names: Sequence[str], place: str) -> list[EditedBox]:
    """Return the box of an annotation, or nothing for an annotation of another type."""
    if not isinstance(each, Mapping):
        raise DataError(f"{place}: not an annotation")
    if each.get("type") != "cuboid_3d":
        return []
    position = numbers(each.get("position"), ("x", "y", "z"), f"{place}, position")
    rotation = numbers(each.get("rotation"), ("x", "y", "z"), f"{place}, rotation")
    scale = numbers(each.get("scale"), ("x", "y", "z"), f"{place}, scale")
    if np.abs(wrap_angle(np.array(rotation[:2]))).max() > _UPRIGHT_RADIANS:
        raise DataError(f"{place}: rotated about x or y; only rotation about z is supported")
    number = each.get("label_id")
    if not isinstance(number, int) or not 0 <= number < len(names):
        raise DataError(f"{place}: label_id {number!r} is not in the file's list of labels")
    yaw = float(wrap_angle(np.array(rotation[2])))
    return [EditedBox(names[number], (*position, *scale, yaw), place)]
