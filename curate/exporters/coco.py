"""Labels as COCO object detection annotations: the 3D boxes projected into the image.

Source: the COCO data format (Lin et al., "Microsoft COCO", ECCV 2014): `bbox` is left, top, width,
height in pixels. Each annotation has these keys besides: `weight`, v; `score`, of pseudo-labels;
`box_3d`, the box in the LiDAR frame; `frame` and `k`. A label of weight 0 that is to be ignored has
`iscrowd` 1, which COCO's readers take for a region to be ignored. One that is background is not
among the `annotations` but, in the same form, in `background`, which they do not read. The info's
`zero_weight` says what a weight of 0 means. A box that the camera does not see has a `bbox` of no
size, which they leave out. Images of X_l carry their ground truth with weight 1.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from curate.exporters.base import LabelFileDescription, LabelSet
from curate.exporters.objects import FrameObjects, categories_of, count_labels, frame_objects
from curate.exporters.place import check_place, says
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
        check_place(path, says("info", _FORMAT))
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
        for annotation, nothing in zip(made, objects.background, strict=True):
            kept = background if nothing else annotations
            kept.append({"id": len(kept) + 1, "image_id": number} | annotation)
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
    """Yield the objects of a frame without their places in the file."""
    found = objects.detections
    seen = np.nan_to_num(image_rectangles(found.boxes, frame.calibration, frame.image_size))
    sizes = seen[:, 2:] - seen[:, :2]
    for k in range(len(found)):
        annotation = {
            "category_id": ids[str(found.categories[k])],
            "bbox": [*seen[k, :2].tolist(), *sizes[k].tolist()],
            "area": float(sizes[k].prod()),
            # Its readers never match what has no area, so nobody should be asked to find it.
            "iscrowd": int(objects.ignored[k] or not sizes[k].all()),
            "weight": float(objects.weights[k]),
            "box_3d": found.boxes[k].tolist(),
            "frame": objects.frame_id,
            "k": k,
        }
        yield annotation if objects.labeled else annotation | {"score": float(found.scores[k])}
