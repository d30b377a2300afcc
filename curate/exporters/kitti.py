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

DIRECTORY/provenance/FRAME.txt exists for frames that people decided about. It has a line for each
of these labels with its k and its provenance: detector, or human if a person decided. A label that
a person rejected has weight 0 and no line in label_2.

DIRECTORY/export.json marks the folder as an export; its `zero_weight` gives the meaning of weight
0. Only a previous export is overwritten.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal, get_args

import numpy as np

from curate.datasets.kitti.labels import (
    DONT_CARE,
    KittiObjects,
    format_objects,
    from_detections,
)
from curate.detections import Detections
from curate.errors import ConfigError, DataError
from curate.exporters.base import LabelSet
from curate.exporters.folder import write_folder
from curate.exporters.objects import BATCH_FRAMES, frame_objects, per_calibration
from curate.files.batches import batched
from curate.frames import Calibration
from curate.weighting.base import ZeroWeight

LastField = Literal["weight", "score", "none"]

_FORMAT = "curate weighted labels, KITTI"
_WEIGHT_LINE = "%s " + " ".join(["%.6f"] * 9) + "\n"


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
        numbers: (n,) k of each label; None for 0 to n - 1.
        provenance: (n,) str, detector or human; None for detector.
    """

    frame_id: str
    labels: Detections
    weights: np.ndarray
    ignored: np.ndarray
    calibration: Calibration
    image_size: tuple[int, int] | None
    numbers: np.ndarray | None = None
    provenance: np.ndarray | None = None


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
            objects.numbers,
            objects.provenance,
        )


def _write_frames(
    folder: Path, frames: Iterable[WeightedFrame], facts: Mapping[str, str]
) -> dict[str, str | int]:
    for part in ("label_2", "weight"):
        (folder / part).mkdir(parents=True)
    labels, seen = 0, set()
    for batch in batched(frames, BATCH_FRAMES):
        for frame in batch:
            if frame.frame_id in seen:
                raise DataError(f"frame {frame.frame_id} occurs twice in the labels to export")
            seen.add(frame.frame_id)
            _check_weights(frame)
        pairs = [(frame.labels, frame) for frame in batch]
        for frame, objects in zip(batch, per_calibration(pairs, _in_camera), strict=True):
            _write_frame(folder, frame, objects, facts["last_field"])
            labels += len(frame.labels)
    return {**facts, "frames": len(seen), "labels": labels}


def _check_weights(frame: WeightedFrame) -> None:
    weights, count = frame.weights, len(frame.labels)
    if weights.shape != (count,) or not ((weights >= 0) & (weights <= 1)).all():
        raise DataError(
            f"frame {frame.frame_id}: needs one weight in [0, 1] for each of {count} labels"
        )


def _in_camera(found: Detections, frame: WeightedFrame) -> KittiObjects:
    return from_detections(found, frame.calibration, frame.image_size)


def _write_frame(
    folder: Path, frame: WeightedFrame, objects: KittiObjects, last_field: str
) -> None:
    weights, labels = frame.weights, frame.labels
    name = f"{frame.frame_id}.txt"
    categories = np.where(frame.ignored, DONT_CARE, objects.categories)
    last = {"weight": weights, "score": labels.scores, "none": np.full(len(labels), np.nan)}
    objects = replace(objects, categories=categories, scores=last[last_field])
    path = folder / "label_2" / name
    path.write_bytes(format_objects(path, objects.select((weights > 0) | frame.ignored)))
    numbers = np.column_stack([weights, labels.scores, labels.boxes]).tolist()
    lines = [
        _WEIGHT_LINE % (category, *row)
        for category, row in zip(labels.categories.tolist(), numbers, strict=True)
    ]
    (folder / "weight" / name).write_bytes("".join(lines).encode())
    if frame.provenance is None or not (frame.provenance == "human").any():
        return
    own = np.arange(len(labels)) if frame.numbers is None else frame.numbers
    lines = [f"{k} {each}\n" for k, each in zip(own, frame.provenance, strict=True)]
    (folder / "provenance").mkdir(exist_ok=True)
    (folder / "provenance" / name).write_text("".join(lines), encoding="utf-8")
