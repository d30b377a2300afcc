"""Weighted labels as KITTI label files, for trainers that read that format.

DIRECTORY/label_2/FRAME.txt holds one line per label in KITTI's format; by choice a 16th field holds
the weight or the score. A label of weight 0 is to be ignored: its line is a DontCare region with
the label's 2D box, so that KITTI's readers take it for neither object nor background.

DIRECTORY/weight/FRAME.txt holds, line by line, what that format has no place for: category,
weight, score, and the box in the LiDAR frame (x, y, z of its centre, length, width, height in
metres, yaw in radians). Only there do ignored labels keep their category and their 3D box.

DIRECTORY/export.json marks the folder as an export; nothing but a former export is overwritten.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import ClassVar, Literal, get_args

import numpy as np

from curate.datasets.kitti.labels import DONT_CARE, from_detections, write_objects
from curate.detections import Detections
from curate.errors import ConfigError, DataError
from curate.exporters.base import BOX_COLUMNS, WEIGHTED_LABEL_COLUMNS, LabelSet, Row
from curate.exporters.folder import write_folder
from curate.frames import Calibration

LastField = Literal["weight", "score", "none"]

_FORMAT = "curate weighted labels, KITTI"


@dataclass(frozen=True)
class WeightedFrame:
    """The weighted labels of one frame, with what it takes to write them in the camera's frame.

    Attributes:
        frame_id: name of the frame.
        labels: boxes in the LiDAR frame, scores, categories.
        weights: (n,) in [0, 1]; 0 means ignore.
        calibration: of the frame.
        image_size: (width, height) in pixels.
    """

    frame_id: str
    labels: Detections
    weights: np.ndarray
    calibration: Calibration
    image_size: tuple[int, int]


class KittiExporter:
    """An `Exporter` that writes KITTI label files of the unlabeled frames."""

    name: ClassVar[str] = "kitti"
    suffix: ClassVar[str] = ""

    def write(self, path: Path, labels: LabelSet) -> int:
        """See `curate.exporters.base.Exporter`.

        Raises:
            DataError: the calibration or the image of a frame cannot be read.
        """
        return export_kitti(path, _weighted_frames(labels))


def export_kitti(
    directory: Path, frames: Iterable[WeightedFrame], *, last_field: LastField = "weight"
) -> int:
    """Writes an export folder, whole or not at all; a former export in its place is replaced.

    Args:
        directory: absent, empty, or a former export.
        frames: those without labels get empty files.
        last_field: what stands in the 16th field of each label line.

    Returns:
        How many labels were written.

    Raises:
        ConfigError: the directory holds something else, or `last_field` is unknown.
        DataError: a weight is not in [0, 1], or a frame occurs twice.
    """
    if last_field not in get_args(LastField):
        raise ConfigError(f"last field {last_field!r}: use one of {', '.join(get_args(LastField))}")
    fill = partial(_write_frames, frames=frames, last_field=last_field)
    return int(write_folder(directory, _FORMAT, fill)["labels"])


def _weighted_frames(labels: LabelSet) -> Iterator[WeightedFrame]:
    """The unlabeled frames with their labels."""
    found: dict[str, list[Row]] = {row[0]: [] for row in labels.frames if row[1] == "unlabeled"}
    names = ("category", "score", *BOX_COLUMNS, "weight")
    wanted = itemgetter(*map(WEIGHTED_LABEL_COLUMNS.index, names))
    for row in labels.labels:
        found[row[1]].append(wanted(row))
    for frame_id, rows in found.items():
        frame = labels.read(frame_id)
        yield WeightedFrame(
            frame_id,
            Detections.from_rows([(*row[:-1], None) for row in rows]),
            np.array([row[-1] for row in rows], dtype=np.float64),
            frame.calibration,
            frame.image_size,
        )


def _write_frames(
    folder: Path, frames: Iterable[WeightedFrame], last_field: LastField
) -> dict[str, str | int]:
    for part in ("label_2", "weight"):
        (folder / part).mkdir(parents=True)
    labels, seen = 0, set()
    for frame in frames:
        if frame.frame_id in seen:
            raise DataError(f"frame {frame.frame_id} occurs twice in the labels to export")
        seen.add(frame.frame_id)
        _write_frame(folder, frame, last_field)
        labels += len(frame.labels)
    return {"last_field": last_field, "frames": len(seen), "labels": labels}


def _write_frame(folder: Path, frame: WeightedFrame, last_field: LastField) -> None:
    weights, labels = frame.weights, frame.labels
    possible = (weights >= 0) & (weights <= 1)
    if weights.shape != (len(labels),) or not possible.all():
        raise DataError(
            f"frame {frame.frame_id}: needs one weight in [0, 1] for each of {len(labels)} labels"
        )
    name = f"{frame.frame_id}.txt"
    objects = from_detections(labels, frame.calibration, frame.image_size)
    shown = np.where(weights == 0, DONT_CARE, objects.categories)
    last = {"weight": weights, "score": labels.scores, "none": np.full(len(labels), np.nan)}
    objects = replace(objects, categories=shown, scores=last[last_field])
    write_objects(folder / "label_2" / name, objects)
    lines = [
        f"{category} {weight:.6f} {score:.6f} {' '.join(f'{number:.6f}' for number in box)}\n"
        for category, weight, score, box in zip(
            labels.categories, weights, labels.scores, labels.boxes, strict=True
        )
    ]
    (folder / "weight" / name).write_text("".join(lines), encoding="utf-8")
