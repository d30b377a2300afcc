"""Export labels as COCO object detection annotations: the 3D boxes projected into the image.

Source: the COCO data format (Lin et al., "Microsoft COCO", ECCV 2014): `bbox` is left, top, width,
height in pixels. Each annotation has additional keys: `weight` (v), `score` (pseudo-labels only),
`box_3d` (the box in the LiDAR frame), `frame`, `k`, and `provenance` (detector, human if a person
decided, or ground_truth). Images of X_l have their ground truth with weight 1.

`zero_weight` in `info` gives the meaning of weight 0. A label to ignore has `iscrowd` 1, which COCO
readers ignore. A background label is not in `annotations` but in `background`, in the same form,
which COCO readers do not read. A box outside the image has a `bbox` of size 0, which they skip.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from curate.exporters.base import LabelFileDescription, LabelSet
from curate.exporters.objects import FrameObjects, categories_of, count_labels, frame_objects
from curate.exporters.place import check_place, has_description
from curate.files.atomic import replace_file
from curate.frames import Frame
from curate.geometry.projection import image_rectangles

_FORMAT = "curate weighted labels, COCO"


class CocoExporter:
    """An `Exporter` that writes one COCO annotation file."""

    name: ClassVar[str] = "coco"
    suffix: ClassVar[str] = ".json"

    def write(self, path: Path, labels: LabelSet) -> int:
        """See `curate.exporters.base.Exporter`.

        Raises:
            DataError: if the calibration or the image of a frame cannot be read.
        """
        check_place(path, has_description("info", _FORMAT))
        frames = list(frame_objects(labels))
        document = _document(labels.description, frames, labels.read)
        replace_file(path, json.dumps(document, allow_nan=False).encode())
        return count_labels(frames)


def _document(
    about: LabelFileDescription, frames: Sequence[FrameObjects], read: Callable[[str], Frame]
) -> dict[str, Any]:
    names = [*about.categories, *sorted(categories_of(frames) - set(about.categories))]
    ids = {name: number for number, name in enumerate(names, start=1)}
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    background: list[dict[str, Any]] = []
    for number, objects in enumerate(frames, start=1):
        frame = read(objects.frame_id)
        images.append(_image(number, objects, frame))
        made = _annotations(objects, frame, ids)
        for annotation, is_background in zip(made, objects.background, strict=True):
            target = background if is_background else annotations
            target.append({"id": len(target) + 1, "image_id": number} | annotation)
    return {
        "info": {
            "description": _FORMAT,
            "dataset": about.dataset,
            "round": about.round,
            "policy": about.policy,
            "zero_weight": about.zero_weight,
            "version": about.code_version,
        },
        "images": images,
        "annotations": annotations,
        "background": background,
        "categories": [{"id": ids[name], "name": name} for name in names],
    }


def _image(number: int, objects: FrameObjects, frame: Frame) -> dict[str, Any]:
    width, height = frame.image_size
    return {
        "id": number,
        "file_name": objects.files[1],
        "width": int(width),
        "height": int(height),
        "frame": objects.frame_id,
        "split": "labeled" if objects.labeled else "unlabeled",
    }


def _annotations(
    objects: FrameObjects, frame: Frame, ids: dict[str, int]
) -> Iterator[dict[str, Any]]:
    """Yield the annotations of a frame without the ids of annotation and image."""
    found = objects.detections
    rectangles = np.nan_to_num(image_rectangles(found.boxes, frame.calibration, frame.image_size))
    sizes = rectangles[:, 2:] - rectangles[:, :2]
    for k in range(len(found)):
        annotation = {
            "category_id": ids[str(found.categories[k])],
            "bbox": [*rectangles[k, :2].tolist(), *sizes[k].tolist()],
            "area": float(sizes[k].prod()),
            # COCO readers never match a box without area: it must not count as a missed object.
            "iscrowd": int(objects.ignored[k] or not sizes[k].all()),
            "weight": float(objects.weights[k]),
            "box_3d": found.boxes[k].tolist(),
            "frame": objects.frame_id,
            "k": int(objects.numbers[k]),
            "provenance": str(objects.provenance[k]),
        }
        yield annotation if objects.labeled else annotation | {"score": float(found.scores[k])}
