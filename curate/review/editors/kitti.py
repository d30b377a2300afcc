"""KITTI's text format: one line per box, for any tool that writes KITTI labels.

DIRECTORY/label_2/FRAME.txt has a line of 15 fields per box; line i is box i of the image.
DIRECTORY/calib/FRAME.txt is the calibration that its camera coordinates refer to. Lines with a
16th field, a score, are accepted too; DontCare regions are skipped.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from curate.datasets.kitti.calibration import write_calibration
from curate.datasets.kitti.labels import (
    DONT_CARE,
    from_detections,
    read_objects,
    read_rows,
    to_detections,
    write_objects,
)
from curate.detections import Detections
from curate.errors import DataError
from curate.review.editors.base import Reader
from curate.review.editors.names import match_frame_names
from curate.review.edits import EditedBox
from curate.review.sheet import Sheet


class KittiEditor:
    """An `Editor` of KITTI label files."""

    name: ClassVar[str] = "kitti"

    def write(self, folder: Path, sheet: Sheet, read: Reader) -> None:
        """See `curate.review.editors.base.Editor`."""
        (folder / "calib").mkdir()
        (folder / "label_2").mkdir()
        for shown in sheet.frames:
            frame = read(shown.frame)
            labels = Detections.from_rows(
                [(box.category, box.score, *box.box, None) for box in shown.boxes]
            )
            objects = from_detections(labels, frame.calibration, frame.image_size)
            unscored = replace(objects, scores=np.full(len(labels), np.nan))
            write_objects(folder / "label_2" / f"{shown.frame}.txt", unscored)
            write_calibration(folder / "calib" / f"{shown.frame}.txt", frame.calibration)

    def read(self, edited: Path, sheet: Sheet, read: Reader) -> Mapping[str, Sequence[EditedBox]]:
        """See `curate.review.editors.base.Editor`."""
        folder = edited / "label_2" if (edited / "label_2").is_dir() else edited
        if not folder.is_dir():
            raise DataError(f"{folder}: no such folder; pass the one that has the FRAME.txt files")
        paths = {
            path.stem: path for path in sorted(folder.glob("*.txt")) if path.name[0] not in "._"
        }
        frames = match_frame_names(folder, paths, sheet)
        return {
            frame: _read_file(paths[name], sheet, frame, read) for name, frame in frames.items()
        }


def _read_file(path: Path, sheet: Sheet, name: str, read: Reader) -> list[EditedBox]:
    objects = read_objects(path, categories={*sheet.categories, DONT_CARE})
    places = [number for number, row in read_rows(path) if row[0] != DONT_CARE]
    found = to_detections(objects, read(name).calibration)
    return [
        EditedBox(str(category), tuple(box), f"{path}:{number}")
        for category, box, number in zip(
            found.categories, found.boxes.tolist(), places, strict=True
        )
    ]
