"""Labels as COCO object detection annotations: the 3D boxes projected into the image.

Source: the COCO data format (Lin et al., "Microsoft COCO", ECCV 2014): `bbox` is left, top, width,
height in pixels. Each annotation has these keys besides: `weight`, v; `score`, of pseudo-labels;
`box_3d`, the box in the LiDAR frame; `frame` and `k`. A label of weight 0 has `iscrowd` 1, which
COCO's readers take for a region to be ignored. A box that the camera does not see has a `bbox` of
no size, which they leave out. Images of X_l carry their ground truth with weight 1.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from curate.errors import ConfigError
from curate.exporters.base import LabelSet, refuse_link
from curate.exporters.objects import FrameObjects, frame_objects
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
            DataError: the calibration or the image of a frame cannot be read.
        """
        _refuse_foreign(path)
        replace_file(path, json.dumps(_document(labels), allow_nan=False).encode())
        return len(labels.labels)


def _document(labels: LabelSet) -> dict[str, Any]:
    about = labels.description
    names = [*about.categories, *sorted(labels.categories - set(about.categories))]
    ids = {name: number for number, name in enumerate(names, start=1)}
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for number, objects in enumerate(frame_objects(labels), start=1):
        frame = labels.read(objects.frame_id)
        images.append(_image(number, objects, frame))
        for annotation in _annotations(objects, frame, ids):
            place = {"id": len(annotations) + 1, "image_id": number}
            annotations.append(place | annotation)
    return {
        "info": {
            "description": _FORMAT,
            "dataset": about.dataset,
            "round": about.round,
            "policy": about.policy,
            "version": about.code_version,
        },
        "images": images,
        "annotations": annotations,
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
    """The objects of a frame without their places in the file."""
    found = objects.detections
    seen = np.nan_to_num(image_rectangles(found.boxes, frame.calibration, frame.image_size))
    sizes = seen[:, 2:] - seen[:, :2]
    for k in range(len(found)):
        weight = float(objects.weights[k])
        annotation = {
            "category_id": ids[str(found.categories[k])],
            "bbox": [*seen[k, :2].tolist(), *sizes[k].tolist()],
            "area": float(sizes[k].prod()),
            # Its readers never match what has no area, so nobody should be asked to find it.
            "iscrowd": int(weight == 0 or not sizes[k].all()),
            "weight": weight,
            "box_3d": found.boxes[k].tolist(),
            "frame": objects.frame_id,
            "k": k,
        }
        yield annotation if objects.labeled else annotation | {"score": float(found.scores[k])}


def _refuse_foreign(path: Path) -> None:
    """ConfigError where something would be lost that is no former export."""
    refuse_link(path)
    if not path.exists():
        return
    try:
        former = json.loads(path.read_bytes())
        known = former["info"]["description"] == _FORMAT
    except (OSError, ValueError, TypeError, KeyError):
        known = False
    if not known:
        raise ConfigError(f"{path}: is there and is no former export; name another file")
