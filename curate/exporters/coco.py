"""Export labels as COCO object detection annotations: the 3D boxes projected into the image.

Source: the COCO data format (Lin et al., "Microsoft COCO", ECCV 2014): `bbox` is left, top, width,
height in pixels. Each annotation has additional keys: `weight` (v), `score` (pseudo-labels only),
`box_3d` (the box in the LiDAR frame), `frame`, `k`, and `provenance` (detector, human if a person
decided, or ground_truth). Images of X_l have their ground truth with weight 1.

`zero_weight` in `info` gives the meaning of weight 0. A label to ignore has `iscrowd` 1, which COCO
readers ignore. A background label is not in `annotations` but in `background`, in the same form,
which COCO readers do not read. A box outside the image has a `bbox` of size 0, which they skip.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from curate.detections import Detections
from curate.errors import ConfigError
from curate.exporters.base import DataToExport, LabelSet
from curate.exporters.json_parts import JsonParts
from curate.exporters.objects import (
    FrameObjects,
    frame_batches,
    per_calibration,
    rows_as_dicts,
)
from curate.exporters.place import check_place, has_description
from curate.frames import Camera, Frame
from curate.geometry.projection import image_rectangles

_FORMAT = "curate weighted labels, COCO"


class CocoExporter:
    """An `Exporter` that writes one COCO annotation file."""

    name: ClassVar[str] = "coco"
    suffix: ClassVar[str] = ".json"

    def write(self, path: Path, labels: LabelSet) -> int:
        """See `curate.exporters.base.Exporter`.

        Raises:
            ConfigError: if the data set has no images.
            DataError: if the calibration or the image of a frame cannot be read.
        """
        check_place(path, has_description("info", _FORMAT))
        about, count = labels.description, 0
        rest = sorted(set(labels.truth()["category"]) - set(about.categories))
        ids = {name: k for k, name in enumerate((*about.categories, *rest), start=1)}
        info = {
            "description": _FORMAT,
            "dataset": about.dataset,
            "round": about.round,
            "policy": about.policy,
            "zero_weight": about.zero_weight,
            "version": about.code_version,
        }
        with JsonParts(path, ("images", "annotations", "background")) as parts:
            for batch in frame_batches(labels, lambda objects: labels.read(objects.frame_id)):
                count += sum(len(each.weights) for each, _ in batch if not each.labeled)
                _add(parts, batch, ids)
            categories = [{"id": number, "name": name} for name, number in ids.items()]
            parts.finish({"info": info}, {"categories": categories})
        return count

    def check_data(self, data: DataToExport) -> None:
        """See `curate.exporters.base.Selective`.

        Raises:
            ConfigError: if the data set has no images.
        """
        _check_images(data.frame, data.images)


def _add(
    parts: JsonParts, batch: Sequence[tuple[FrameObjects, Frame]], ids: dict[str, int]
) -> None:
    """Write the images and annotations of some frames; new categories are added to `ids`."""
    single = [(objects.detections, frame) for objects, frame in batch if len(frame.cameras) == 1]
    rectangles = iter(per_calibration(single, _rectangles))
    for objects, frame in batch:
        _check_images(frame, objects.images)
        found = [next(rectangles)] if len(frame.cameras) == 1 else None
        if found is None:
            boxes = objects.detections.boxes
            found = [image_rectangles(boxes, c.calibration, c.image_size) for c in frame.cameras]
        # A label outside all images is with the first one, so that no label is lost.
        unseen = np.isnan(found).any(axis=2).all(axis=0)
        for number, (camera, own) in enumerate(zip(frame.cameras, found, strict=True)):
            image = parts.next_id("images")
            parts.add("images", [_image(image, objects, camera, number)])
            shown = ~np.isnan(own).any(axis=1) | (unseen & (number == 0))
            made = _annotations(objects, np.nan_to_num(own), ids)
            for part, written in (
                ("annotations", shown & ~objects.background),
                ("background", shown & objects.background),
            ):
                chosen = [made[k] for k in np.flatnonzero(written).tolist()]
                first = parts.next_id(part)
                numbered = enumerate(chosen, start=first)
                parts.add(part, [{"id": n, "image_id": image, **each} for n, each in numbered])


def _rectangles(found: Detections, frame: Frame) -> np.ndarray:
    return image_rectangles(found.boxes, frame.calibration, frame.image_size)


def _check_images(frame: Frame, images: Sequence[Any]) -> None:
    """Raise ConfigError if a frame has no camera, or no image."""
    if not frame.cameras or not images:
        raise ConfigError(
            f"frame {frame.frame_id}: COCO's annotations need images, and the data set has none; "
            "export another format, such as kitti, csv or parquet"
        )


def _image(number: int, objects: FrameObjects, camera: Camera, position: int) -> dict[str, Any]:
    width, height = camera.image_size
    return {
        "id": number,
        "file_name": objects.images[position],
        "width": int(width),
        "height": int(height),
        "frame": objects.frame_id,
        **({"camera": camera.name} if camera.name else {}),
        "split": "labeled" if objects.labeled else "unlabeled",
    }


def _annotations(
    objects: FrameObjects, rectangles: np.ndarray, ids: dict[str, int]
) -> list[dict[str, Any]]:
    """Return the annotations of all labels in one image, without their ids.

    Args:
        objects: the labels of a frame.
        rectangles: (n, 4) their rectangles in the image; 0 for labels outside.
        ids: number of each category; new categories are added.
    """
    found = objects.detections
    sizes = rectangles[:, 2:] - rectangles[:, :2]
    return rows_as_dicts(
        {
            "category_id": [ids.setdefault(c, len(ids) + 1) for c in found.categories.tolist()],
            "bbox": np.hstack([rectangles[:, :2], sizes]),
            "area": sizes.prod(axis=1),
            # COCO readers never match a box without area: it must not count as a missed object.
            "iscrowd": (objects.ignored | ~sizes.all(axis=1)).astype(int),
            "weight": objects.weights,
            "box_3d": found.boxes,
            "frame": [objects.frame_id] * len(found),
            "k": objects.numbers,
            "provenance": objects.provenance,
            **({} if objects.labeled else {"score": found.scores}),
        }
    )
