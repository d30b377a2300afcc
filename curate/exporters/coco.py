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

from curate.errors import ConfigError
from curate.exporters.base import DataToExport, LabelFileDescription, LabelSet
from curate.exporters.objects import FrameObjects, categories_of, count_labels, frame_objects
from curate.exporters.place import check_place, has_description
from curate.files.atomic import replace_file
from curate.frames import Camera, Frame
from curate.geometry.projection import camera_of_boxes, image_rectangles

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
        frames = list(frame_objects(labels))
        document = _document(labels.description, frames, labels.read)
        replace_file(path, json.dumps(document, allow_nan=False).encode())
        return count_labels(frames)

    def check_data(self, data: DataToExport) -> None:
        """See `curate.exporters.base.Selective`.

        Raises:
            ConfigError: if the data set has no images.
        """
        _check_images(data.frame, data.images)


def _document(
    about: LabelFileDescription, frames: Sequence[FrameObjects], read: Callable[[str], Frame]
) -> dict[str, Any]:
    names = [*about.categories, *sorted(categories_of(frames) - set(about.categories))]
    ids = {name: number for number, name in enumerate(names, start=1)}
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    background: list[dict[str, Any]] = []
    for objects in frames:
        frame = read(objects.frame_id)
        _check_images(frame, objects.images)
        shown_by = camera_of_boxes(objects.detections.boxes, frame.cameras)
        for number, camera in enumerate(frame.cameras):
            images.append(_image(len(images) + 1, objects, camera, number))
            # A label outside all images is with the first one, so that no label is lost.
            first = (shown_by < 0) & (number == 0)
            made = _annotations(objects, camera, ids, first)
            for k, annotation in made:
                target = background if objects.background[k] else annotations
                target.append({"id": len(target) + 1, "image_id": len(images)} | annotation)
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
    objects: FrameObjects, camera: Camera, ids: dict[str, int], unseen: np.ndarray
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield k and the annotation, without its ids, of the labels that a camera shows.

    Args:
        objects: the labels of a frame.
        camera: the camera.
        ids: numbers of the categories.
        unseen: (n,) bool, labels outside all images that are written with this image.
    """
    found = objects.detections
    rectangles = image_rectangles(found.boxes, camera.calibration, camera.image_size)
    shown = unseen | ~np.isnan(rectangles).any(axis=1)
    rectangles = np.nan_to_num(rectangles)
    sizes = rectangles[:, 2:] - rectangles[:, :2]
    for k in np.flatnonzero(shown).tolist():
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
        scored = {} if objects.labeled else {"score": float(found.scores[k])}
        yield k, annotation | scored
