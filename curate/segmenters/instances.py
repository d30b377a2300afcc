"""Precomputed instance masks in COCO's JSON format, combined into a semantic map.

Source: COCO's data format: annotations `{images, annotations}`, a list of results, or one such file
per frame. Where masks overlap, the mask with the higher score is on top.
"""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from curate.errors import ConfigError, DataError, one_line
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.segmenters.base import SemanticMap, image_size_of
from curate.segmenters.classes import background_id, checked_classes
from curate.segmenters.masks import decode_mask

Objects = Sequence[Mapping[str, Any]]


class InstanceSegmenter:
    """A `Segmenter` that reads instance masks from JSON.

    Args:
        path: a file with `images` and `annotations`; a file with a list of results, where
            `image_id` is the frame's name or number; or a folder with a file FRAME.json per frame,
            which contains such a list or `{annotations: [...]}`. With several cameras, the names
            are CAMERA/FRAME.
        classes: the COCO category ids that count for each category.
        minimum_score: masks below it are dropped; a mask without a score counts as score 1.

    Raises:
        DataError: if the path is missing, or contains no instance masks.
        ConfigError: if a class id or the score is out of range.
    """

    needs_image = False

    def __init__(
        self, path: StrPath, classes: Mapping[str, Sequence[int]], *, minimum_score: float = 0.5
    ) -> None:
        if not 0 <= minimum_score <= 1:
            raise ConfigError(f"segmenter minimum_score {minimum_score}: expected 0 to 1")
        self.path = Path(path)
        self.classes = checked_classes(classes)
        self.minimum_score = minimum_score
        self._frames = None if self.path.is_dir() else _by_frame(self.path)

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the frame's masks as a semantic map.

        Raises:
            DataError: if the frame has no masks, or a mask is malformed or of another size.
        """
        size = width, height = image_size_of(frame)
        used_ids = {class_id for ids in self.classes.values() for class_id in ids}
        background = background_id(self.classes)
        class_ids = np.full((height, width), background, dtype=np.uint8)
        source, objects = self._objects(frame.frame_id, frame.camera)
        scored = [(_score(source, number, entry), number) for number, entry in enumerate(objects)]
        for score, number in sorted(scored, key=lambda pair: pair[0]):
            if score < self.minimum_score:
                continue
            entry = objects[number]
            try:
                mask = decode_mask(entry["segmentation"], size)
                category = entry["category_id"]
            except KeyError as error:
                raise DataError(f"{source}: object {number} has no {error.args[0]}") from None
            except DataError as error:
                raise DataError(f"{source}: object {number}: {error}") from None
            if not isinstance(category, int):
                raise DataError(f"{source}: object {number}: category_id is not an integer")
            class_ids[mask] = category if category in used_ids else background
        return SemanticMap(class_ids, self.classes)

    def _objects(self, frame_id: str, camera: str) -> tuple[str, Objects]:
        """Return the place of a frame's objects, for error messages, and the objects."""
        if self._frames is None:
            path = self.path / camera / f"{frame_id}.json"
            return str(path), _object_list(path, _read(path))
        name = f"{camera}/{frame_id}" if camera else frame_id
        number = int(frame_id) if frame_id.isdecimal() and not camera else None
        for key in (name, number):
            if key in self._frames:
                return f"{self.path}: frame {name}", self._frames[key]
        raise DataError(
            f"{self.path}: no masks for frame {name}; list a frame without objects in `images`: "
            f'{{"images": [{{"id": 1, "file_name": "{name}.png"}}], "annotations": [...]}}'
        )


def _by_frame(path: Path) -> dict[str | int, list[Mapping[str, Any]]]:
    """Return the objects of each frame, by its name or by the `image_id` of a list of results."""
    document = _read(path)
    images = document.get("images", ()) if isinstance(document, dict) else ()
    try:
        keys = _keys({image["id"]: Path(image["file_name"]) for image in images})
        frames: dict[str | int, list[Mapping[str, Any]]] = {
            key: [] for of_image in keys.values() for key in of_image
        }
        for entry in _object_list(path, document):
            for key in keys[entry["image_id"]] if keys else (entry["image_id"],):
                frames.setdefault(key, []).append(entry)
    except (KeyError, TypeError) as error:
        words = f"no {error.args[0]!s:.80}" if isinstance(error, KeyError) else str(error)
        raise DataError(
            f"{path}: not COCO's format of images and masks: {' '.join(words.split())}"
        ) from None
    return frames


def _keys(files: Mapping[Any, Path]) -> dict[Any, list[str]]:
    """Return the names of each image: CAMERA/FRAME, and FRAME if no other image has that name."""
    stems = Counter(file.stem for file in files.values())
    return {
        number: [
            *([file.stem] if stems[file.stem] == 1 else []),
            *([f"{file.parent.name}/{file.stem}"] if file.parent.name else []),
        ]
        for number, file in files.items()
    }


def _object_list(path: Path, document: Any) -> list[Mapping[str, Any]]:
    """Return the annotations of a COCO document or of a list of results."""
    objects = document.get("annotations") if isinstance(document, dict) else document
    if not isinstance(objects, list) or not all(isinstance(entry, dict) for entry in objects):
        raise DataError(
            f"{path}: expected a list of instance masks, or a document {{annotations: [...]}}"
        )
    return objects


def _score(source: str, number: int, entry: Mapping[str, Any]) -> float:
    score = entry.get("score", 1.0)
    if not isinstance(score, int | float) or not 0 <= score <= 1:
        raise DataError(f"{source}: object {number}: the score is not a number from 0 to 1")
    return float(score)


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError:
        raise DataError(f"{path}: no such file of instance masks") from None
    except (OSError, RecursionError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as JSON: {one_line(error, 200)}") from None
