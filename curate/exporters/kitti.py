"""Export weighted labels as KITTI label files, for trainers that read this format.

DIRECTORY/label_2/FRAME.txt has one line per label in KITTI's format; rotation_y has the meaning
that the data set declares for its own labels. An optional 16th field is the weight or the score.
Labels of weight 0 are not objects there. A label to ignore is a DontCare region with the label's 2D
box, which KITTI readers treat neither as an object nor as background. A background label has no
line.

DIRECTORY/weight/FRAME.txt has one line for every label, in the same order, including the labels
that have no line in label_2. The line contains category, weight, score, and the box in the LiDAR
frame (x, y, z of its centre, length, width, height in metres, yaw in radians). Labels of weight 0
have their category and 3D box only in this file.

DIRECTORY/export.json marks the folder as an export; its `zero_weight` gives the meaning of weight
0. Only a previous export is overwritten.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal, get_args

import numpy as np

from curate.datasets.kitti.labels import DONT_CARE, from_detections, write_objects
from curate.detections import Detections
from curate.errors import ConfigError, DataError, error_prefix
from curate.exporters.base import LabelSet
from curate.exporters.folder import write_folder
from curate.exporters.objects import frame_objects
from curate.frames import Calibration
from curate.weighting.base import ZeroWeight

LastField = Literal["weight", "score", "none"]

_FORMAT = "curate weighted labels, KITTI"


@dataclass(frozen=True)
class WeightedFrame:
    """The weighted labels of one frame, with its calibration and image size.

    Attributes:
        frame_id: name of the frame.
        labels: boxes in the LiDAR frame, scores, categories.
        weights: (n,) in [0, 1].
        ignored: (n,) bool, True for labels of weight 0 that are regions to ignore; the others of
            weight 0 are background.
        calibration: calibration of the frame.
        image_size: (width, height) in pixels; None without a camera.
    """

    frame_id: str
    labels: Detections
    weights: np.ndarray
    ignored: np.ndarray
    calibration: Calibration
    image_size: tuple[int, int] | None


class KittiExporter:
    """An `Exporter` that writes KITTI label files of the unlabeled frames."""

    name: ClassVar[str] = "kitti"
    suffix: ClassVar[str] = ""

    def write(self, path: Path, labels: LabelSet) -> int:
        """See `curate.exporters.base.Exporter`.

        Raises:
            DataError: if the calibration or the image of a frame cannot be read, or the mounting of
                the camera does not define headings.
        """
        zero_weight = labels.description.zero_weight
        return export_kitti(path, _weighted_frames(labels), zero_weight=zero_weight)


def export_kitti(
    directory: Path,
    frames: Iterable[WeightedFrame],
    *,
    last_field: LastField = "weight",
    zero_weight: ZeroWeight = "background",
) -> int:
    """Write an export folder atomically; a previous export at the same path is replaced.

    Args:
        directory: absent, empty, or a previous export.
        frames: the frames to write; a frame without labels gets empty files.
        last_field: content of the 16th field of each label line.
        zero_weight: the meaning of weight 0, written to the marker file.

    Returns:
        The number of labels.

    Raises:
        ConfigError: if the directory contains something else, or `last_field` is unknown.
        DataError: if a weight is not in [0, 1], or a frame occurs twice.
    """
    if last_field not in get_args(LastField):
        raise ConfigError(f"last field {last_field!r}: use one of {', '.join(get_args(LastField))}")
    facts = {"last_field": last_field, "zero_weight": zero_weight}
    fill = partial(_write_frames, frames=frames, facts=facts)
    return int(write_folder(directory, _FORMAT, fill)["labels"])


def _weighted_frames(labels: LabelSet) -> Iterator[WeightedFrame]:
    """Yield the unlabeled frames with their labels."""
    for objects in frame_objects(labels):
        if objects.labeled:
            continue
        frame = labels.read(objects.frame_id)
        yield WeightedFrame(
            objects.frame_id,
            objects.detections,
            objects.weights,
            objects.ignored,
            frame.calibration,
            frame.image_size,
        )


def _write_frames(
    folder: Path, frames: Iterable[WeightedFrame], facts: Mapping[str, str]
) -> dict[str, str | int]:
    for part in ("label_2", "weight"):
        (folder / part).mkdir(parents=True)
    labels, seen = 0, set()
    for frame in frames:
        if frame.frame_id in seen:
            raise DataError(f"frame {frame.frame_id} occurs twice in the labels to export")
        seen.add(frame.frame_id)
        _write_frame(folder, frame, facts["last_field"])
        labels += len(frame.labels)
    return {**facts, "frames": len(seen), "labels": labels}


def _write_frame(folder: Path, frame: WeightedFrame, last_field: str) -> None:
    weights, labels = frame.weights, frame.labels
    valid = (weights >= 0) & (weights <= 1)
    if weights.shape != (len(labels),) or not valid.all():
        raise DataError(
            f"frame {frame.frame_id}: needs one weight in [0, 1] for each of {len(labels)} labels"
        )
    name = f"{frame.frame_id}.txt"
    with error_prefix(f"frame {frame.frame_id}"):
        objects = from_detections(labels, frame.calibration, frame.image_size)
    categories = np.where(frame.ignored, DONT_CARE, objects.categories)
    last = {"weight": weights, "score": labels.scores, "none": np.full(len(labels), np.nan)}
    objects = replace(objects, categories=categories, scores=last[last_field])
    kept = (weights > 0) | frame.ignored
    write_objects(folder / "label_2" / name, objects.select(kept))
    lines = [
        f"{category} {weight:.6f} {score:.6f} {' '.join(f'{number:.6f}' for number in box)}\n"
        for category, weight, score, box in zip(
            labels.categories, weights, labels.scores, labels.boxes, strict=True
        )
    ]
    (folder / "weight" / name).write_text("".join(lines), encoding="utf-8")
