"""Export weighted labels as the pseudo-label file of ST3D and MS3D.

Source: Yang et al., "ST3D", CVPR 2021, and Tsai et al., "MS3D", RA-L 2023, with their code
(github.com/CVMI-Lab/ST3D, github.com/darrenjkt/MS3D). DIRECTORY/ps_label_e0.pkl, to be set as
SELF_TRAIN.INIT_PS, is a dict by frame id of X_u:

    gt_boxes        (n, 9) float32: x, y, z of the box centre, length, width, height, yaw in the
                    LiDAR frame; category, from 1 in the order of the configured categories, and
                    negative for a label of weight 0 that is a region to ignore; score
    cls_scores      (n,) float32 scores
    iou_scores      None
    memory_counter  (n,) zeros: no round has missed the label yet
    weight          (n,) v, for a loss that uses it
    k, provenance   (n,) number of the label; detector, or human if a person decided

Background labels of weight 0 are omitted, like the labels that ST3D itself drops. `zero_weight` of
export.json gives the meaning of weight 0.

The boxes are not shifted. A data set configuration with SHIFT_COOR expects shifted coordinates.
"""

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from curate.errors import DataError
from curate.exporters.base import LabelSet
from curate.exporters.folder import Streamed, write_folder, write_pickle
from curate.exporters.objects import FrameObjects, frame_objects

_FORMAT = "curate weighted labels, ST3D"


class ST3DExporter:
    """An `Exporter` that writes ST3D's and MS3D's pseudo-labels."""

    name: ClassVar[str] = "st3d"
    suffix: ClassVar[str] = ""

    def write(self, path: Path, labels: LabelSet) -> int:
        """See `curate.exporters.base.Exporter`.

        Raises:
            DataError: if a label's category is not among the configured ones.
        """
        return int(write_folder(path, _FORMAT, partial(_fill, labels=labels))["labels"])


def _fill(folder: Path, labels: LabelSet) -> Mapping[str, Any]:
    about = labels.description
    facts = {"zero_weight": about.zero_weight, "frames": 0, "labels": 0}
    write_pickle(folder / "ps_label_e0.pkl", Streamed(_frames(labels, facts), dict))
    return {**facts, "categories": list(about.categories)}


def _frames(labels: LabelSet, facts: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the unlabeled frames, and count frames and labels."""
    for objects in frame_objects(labels):
        if not objects.labeled:
            found = _pseudo_labels(objects, labels.description.categories)
            facts["frames"] += 1
            facts["labels"] += len(found["weight"])
            yield objects.frame_id, found


def _pseudo_labels(objects: FrameObjects, categories: tuple[str, ...]) -> dict[str, Any]:
    kept = ~objects.background
    found, weights = objects.detections.select(kept), objects.weights[kept]
    numbers = {name: number for number, name in enumerate(categories, start=1)}
    unexpected = sorted(set(found.categories.tolist()) - set(numbers))
    if unexpected:
        raise DataError(
            f"frame {objects.frame_id}: category {unexpected[0]!r} is not in dataset.categories "
            f"({', '.join(categories)}); add it there"
        )
    order = np.array([numbers[str(name)] for name in found.categories], dtype=np.float64)
    order = np.where(weights == 0, -order, order)
    boxes = np.column_stack([found.boxes, order, found.scores])
    return {
        "gt_boxes": boxes.astype(np.float32),
        "cls_scores": found.scores.astype(np.float32),
        "iou_scores": None,
        "memory_counter": np.zeros(len(found)),
        "weight": weights,
        "k": objects.numbers[kept],
        "provenance": objects.provenance[kept],
    }
