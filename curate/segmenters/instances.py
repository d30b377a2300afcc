"""Masks of single objects that were computed before, in COCO's JSON, laid over each other as a map.

Source: COCO's data format, as annotations `{images, annotations}`, as a list of results, or as one
such file per frame. Where masks overlap, the higher score is on top.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from curate.errors import ConfigError, DataError, one_line
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.segmenters.base import SemanticMap
from curate.segmenters.classes import checked_classes, free_id
from curate.segmenters.masks import decode_mask

Objects = Sequence[Mapping[str, Any]]


class InstanceSegmenter:
    """A `Segmenter` that reads instance masks from JSON.

    Args:
        path: a file with `images` and `annotations`; a list of results whose `image_id` is the
            frame's name or its number; or a folder with such a list, or `{annotations: [...]}`, in
            FRAME.json.
        classes: the category ids that count for each category.
        minimum_score: masks below it are left out; masks without score are certain.

    Raises:
        DataError: the path is missing, or holds no instance masks.
        ConfigError: a class id or the score is out of range.
    """

    needs_image = False

    def __init__(
        self, path: StrPath, classes: Mapping[str, Sequence[int]], *, minimum_score: float = 0.5
    ) -> None:
        if not 0 <= minimum_score <= 1:
            raise ConfigError(f"segmenter minimum_score {minimum_score}: 0 to 1")
        self.path = Path(path)
        self.classes = checked_classes(classes)
        self.minimum_score = minimum_score
        self._frames = None if self.path.is_dir() else _by_frame(self.path)

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the frame's masks as a semantic map.

        Raises:
            DataError: if there are none for the frame, or one is malformed or of another size.
        """
        width, height = frame.image_size
        wanted = {one for ids in self.classes.values() for one in ids}
        nothing = free_id(self.classes)
        class_ids = np.full((height, width), nothing, dtype=np.uint8)
        place, objects = self._objects(frame.frame_id)
        scored = [(_score(place, number, one), number) for number, one in enumerate(objects)]
        for score, number in sorted(scored, key=lambda pair: pair[0]):
            if score < self.minimum_score:
                continue
            one = objects[number]
            try:
                mask = decode_mask(one["segmentation"], frame.image_size)
                category = one["category_id"]
            except KeyError as error:
                raise DataError(f"{place}: object {number} has no {error.args[0]}") from None
            except DataError as error:
                raise DataError(f"{place}: object {number}: {error}") from None
            if not isinstance(category, int):
                raise DataError(f"{place}: object {number}: the category_id is no whole number")
            class_ids[mask] = category if category in wanted else nothing
        return SemanticMap(class_ids, self.classes)

    def _objects(self, frame_id: str) -> tuple[str, Objects]:
        """Where a frame's objects are written, and they."""
        if self._frames is None:
            path = self.path / f"{frame_id}.json"
            return str(path), _listed(path, _read(path))
        number = int(frame_id) if frame_id.isdecimal() else None
        for key in (frame_id, number):
            if key in self._frames:
                return f"{self.path}: frame {frame_id}", self._frames[key]
        raise DataError(
            f"{self.path}: no masks for frame {frame_id}; a frame without objects belongs into "
            '`images`: {"images": [{"id": 1, "file_name": "FRAME.png"}], "annotations": [...]}'
        )


def _by_frame(path: Path) -> dict[str | int, list[Mapping[str, Any]]]:
    """The objects of each frame by its name, or by the number that a list of results gives it."""
    held = _read(path)
    images = held.get("images", ()) if isinstance(held, dict) else ()
    try:
        names = {image["id"]: Path(image["file_name"]).stem for image in images}
        frames: dict[str | int, list[Mapping[str, Any]]] = {name: [] for name in names.values()}
        for one in _listed(path, held):
            key = one["image_id"]
            frames.setdefault(names[key] if names else key, []).append(one)
    except (KeyError, TypeError) as error:
        words = f"no {error.args[0]!s:.80}" if isinstance(error, KeyError) else str(error)
        raise DataError(
            f"{path}: not COCO's format of images and masks: {' '.join(words.split())}"
        ) from None
    return frames


def _listed(path: Path, held: Any) -> list[Mapping[str, Any]]:
    """Return the annotations of a document or of a bare list."""
    objects = held.get("annotations") if isinstance(held, dict) else held
    if not isinstance(objects, list) or not all(isinstance(one, dict) for one in objects):
        raise DataError(f"{path}: no list of instance masks, nor {{annotations: [...]}}")
    return objects


def _score(place: str, number: int, one: Mapping[str, Any]) -> float:
    score = one.get("score", 1.0)
    if not isinstance(score, int | float) or not 0 <= score <= 1:
        raise DataError(f"{place}: object {number}: the score is no number from 0 to 1")
    return float(score)


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError:
        raise DataError(f"{path}: no such file of instance masks") from None
    except (OSError, RecursionError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as JSON: {one_line(error, 200)}") from None
