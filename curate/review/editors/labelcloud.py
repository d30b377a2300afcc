"""labelCloud's centroid format: a JSON file and a point file per frame.

Source: labelCloud (ch-sa/labelCloud), its documentation pages Conventions and Configuration and
its example labels: `labels/FRAME.json` holds objects with name, centroid, dimensions (length,
width, height; the length along x before the turn) and rotations, which in the format centroid_abs
are degrees, counter-clockwise, 0 to 360; `labels/_classes.json` holds the classes and the format;
`pointclouds/` and `labels/` are the folders that it opens by default. A .bin is read as float32
rows of four values. According to its own log, labelCloud has problems with .pcd files on Linux.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from curate.errors import DataError
from curate.files.json_text import read_json
from curate.geometry.similarity import wrap_angle
from curate.review.editors.base import Reader
from curate.review.editors.documents import numbers, write_json
from curate.review.editors.names import match_frame_names
from curate.review.edits import EditedBox
from curate.review.sheet import Sheet, ShownFrame

_COLOURS = ("#FFD23F", "#3BCEAC", "#EE4266", "#9DA2AB", "#4C9BE8", "#B388EB")
_DECIMALS = 6
_UPRIGHT_DEGREES = 0.5


class LabelCloudEditor:
    """An `Editor` of labelCloud's folders."""

    name: ClassVar[str] = "labelcloud"

    def write(self, folder: Path, sheet: Sheet, read: Reader) -> None:
        """See `curate.review.editors.base.Editor`."""
        (folder / "pointclouds").mkdir()
        (folder / "labels").mkdir()
        classes = [
            {"name": name, "id": i, "color": _COLOURS[i % len(_COLOURS)]}
            for i, name in enumerate(sheet.categories)
        ]
        definition = {
            "classes": classes,
            "default": 0,
            "type": "object_detection",
            "format": "centroid_abs",
        }
        write_json(folder / "labels" / "_classes.json", definition)
        for shown in sheet.frames:
            points = read(shown.frame).points.astype("<f4")
            (folder / "pointclouds" / f"{shown.frame}.bin").write_bytes(points.tobytes())
            write_json(folder / "labels" / f"{shown.frame}.json", _document(shown))

    def read(
        self,
        edited: Path,
        sheet: Sheet,
        read: Reader,  # noqa: ARG002 - its boxes are in the LiDAR frame
    ) -> Mapping[str, Sequence[EditedBox]]:
        """See `curate.review.editors.base.Editor`."""
        folder = edited / "labels" if (edited / "labels").is_dir() else edited
        if not folder.is_dir():
            raise DataError(f"{folder}: no such folder; pass the one that has the FRAME.json files")
        paths = {
            path.stem: path for path in sorted(folder.glob("*.json")) if path.name[0] not in "._"
        }
        paths.pop("review", None)
        frames = match_frame_names(folder, paths, sheet)
        return {frame: _read_file(paths[name]) for name, frame in frames.items()}


def _document(shown: ShownFrame) -> dict[str, Any]:
    objects = []
    for box in shown.boxes:
        values = [round(value, _DECIMALS) for value in box.box[:6]]
        degrees = round(float(np.rad2deg(box.box[6])) % 360, _DECIMALS)
        objects.append(
            {
                "name": box.category,
                "centroid": dict(zip("xyz", values[:3], strict=True)),
                "dimensions": dict(zip(("length", "width", "height"), values[3:], strict=True)),
                "rotations": {"x": 0.0, "y": 0.0, "z": degrees},
            }
        )
    name = f"{shown.frame}.bin"
    return {
        "folder": "pointclouds",
        "filename": name,
        "path": f"pointclouds/{name}",
        "objects": objects,
    }


def _read_file(path: Path) -> list[EditedBox]:
    document = read_json(path)
    objects = document.get("objects") if isinstance(document, Mapping) else None
    if not isinstance(objects, list):
        raise DataError(f"{path}: has no list 'objects'; save it from labelCloud as centroid_abs")
    return [_read_object(each, f"{path}: object {i}") for i, each in enumerate(objects, start=1)]


def _read_object(each: Any, place: str) -> EditedBox:
    if not isinstance(each, Mapping) or not isinstance(each.get("name"), str):
        raise DataError(f"{place}: has no name; save it from labelCloud as centroid_abs")
    values = [
        *numbers(each.get("centroid"), ("x", "y", "z"), place),
        *numbers(each.get("dimensions"), ("length", "width", "height"), place),
    ]
    tilt_x, tilt_y, turn = numbers(each.get("rotations"), ("x", "y", "z"), place)
    if max(abs((tilt + 180) % 360 - 180) for tilt in (tilt_x, tilt_y)) > _UPRIGHT_DEGREES:
        raise DataError(f"{place}: rotated about x or y; only rotation about z is supported")
    yaw = float(wrap_angle(np.deg2rad(turn)))
    return EditedBox(each["name"], (*values, yaw), place)
