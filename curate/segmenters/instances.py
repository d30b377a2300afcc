"""Precomputed instance masks in COCO's JSON format, combined into a semantic map.

Source: COCO's data format: annotations `{images, annotations}`, a list of results, or one such file
per frame. Where masks overlap, the mask with the higher score is on top.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from curate.datasets.frame_names import FrameNames, files_by_frame, last_part
from curate.errors import ConfigError, DataError
from curate.files.json_text import read_json
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.ranges import Share
from curate.segmenters.base import Segmenter, SemanticMap, image_size_of
from curate.segmenters.classes import background_id, checked_classes
from curate.segmenters.masks import decode_mask

Objects = Sequence[Mapping[str, Any]]


class InstanceSegmenter(Segmenter):
    """A `Segmenter` that reads instance masks from JSON.

    Args:
        path: a file with `images` and `annotations`; a file with a list of results, where
            `image_id` is the frame's name or number; or a folder with a file FRAME.json per frame,
            which contains such a list or `{annotations: [...]}`. With several cameras, the names
            are CAMERA/FRAME.
        classes: the COCO category ids that count for each category.
        minimum_score: masks below it are dropped; a mask without a score counts as score 1.
        frame_ids: the frames of the data set, with which the names of files and images are matched
            in the spellings of `curate.datasets.frame_names`; without them, names are frame ids.

    Raises:
        DataError: if the path is missing, or contains no instance masks.
        ConfigError: if a class id or the score is out of range.
    """

    needs_image = False
    needs_points = False

    def __init__(
        self,
        path: StrPath,
        classes: Mapping[str, Sequence[int]],
        *,
        minimum_score: Share = 0.5,
        frame_ids: Sequence[str] = (),
    ) -> None:
        if not 0 <= minimum_score <= 1:
            raise ConfigError(f"segmenter.options.minimum_score {minimum_score}: expected 0 to 1")
        self.path = Path(path)
        self.classes = checked_classes(classes)
        self.minimum_score = minimum_score
        self._frame_ids = frame_ids
        self._files: dict[str, Mapping[str, Path]] = {}
        self._frames: dict[str, Mapping[str, Objects]] = {}
        self._images = {} if self.path.is_dir() else _by_image(self.path)
        # With images of one name in several folders, the camera of a frame decides which is meant.
        if self._images and len(set(map(last_part, self._images))) == len(self._images):
            self._objects_by_frame("")
        elif self.path.is_dir() and next(self.path.glob("*.json"), None):
            self._file_by_frame("")

    def _file_by_frame(self, camera: str) -> Mapping[str, Path]:
        """Return the file of each frame from a camera; "" for the only one."""
        if camera not in self._files:
            folder = self.path / camera
            self._files[camera] = files_by_frame(folder, "*.json", self._frame_ids)
        return self._files[camera]

    def _objects_by_frame(self, camera: str) -> Mapping[str, Objects]:
        """Return the objects of each frame from a camera; "" for the only one."""
        if camera not in self._frames:
            names = FrameNames.of(self._frame_ids)
            self._frames[camera] = _by_frame(self.path, self._images, names, camera)
        return self._frames[camera]

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the frame's masks as a semantic map.

        Raises:
            DataError: if the frame has no masks, or a mask is malformed or of another size.
        """
        size = width, height = image_size_of(frame)
        used_ids = {class_id for ids in self.classes.values() for class_id in ids}
        background = background_id(self.classes)
        class_ids = np.full((height, width), background, dtype=np.uint8)
        instances = np.zeros((height, width), dtype=np.int64)
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
            instances[mask] = number + 1 if category in used_ids else 0
        return SemanticMap(class_ids, self.classes, instances)

    def _objects(self, frame_id: str, camera: str) -> tuple[str, Objects]:
        """Return the place of a frame's objects, for error messages, and the objects."""
        name = f"{camera}/{frame_id}" if camera else frame_id
        if self.path.is_dir():
            default = self.path / camera / f"{frame_id}.json"
            path = self._file_by_frame(camera).get(frame_id, default)
            return str(path), _object_list(path, read_json(path, "instance mask"))
        frames = self._objects_by_frame(camera)
        names = (frame_id, str(int(frame_id))) if frame_id.isdecimal() else (frame_id,)
        for each in names:
            if each in frames:
                return f"{self.path}: frame {name}", frames[each]
        raise DataError(
            f"{self.path}: no masks for frame {name}; list a frame without objects in `images`: "
            f'{{"images": [{{"id": 1, "file_name": "{name}.png"}}], "annotations": [...]}}'
        )


def _by_image(path: Path) -> dict[str, list[Mapping[str, Any]]]:
    """Return the objects of each image by its name, as the file spells it."""
    document = read_json(path, "instance mask")
    images = document.get("images", ()) if isinstance(document, dict) else ()
    try:
        names = {image["id"]: str(image["file_name"]) for image in images}
        found: dict[str, list[Mapping[str, Any]]] = {name: [] for name in names.values()}
        for entry in _object_list(path, document):
            key = entry["image_id"]
            found.setdefault(names[key] if names else str(key), []).append(entry)
    except (KeyError, TypeError) as error:
        words = f"no {error.args[0]!s:.80}" if isinstance(error, KeyError) else str(error)
        raise DataError(
            f"{path}: not COCO's format of images and masks: {' '.join(words.split())}"
        ) from None
    if len(found) < len(names):
        raise DataError(f"{path}: two images have the same file_name; remove one")
    return found


def _folder(name: str) -> str:
    """Return the folder of an image, which may be the name of its camera; "" without a folder."""
    return PurePosixPath(name.replace("\\", "/")).parent.name


def _by_frame(
    path: Path, found: Mapping[str, Objects], frame_ids: FrameNames, camera: str
) -> Mapping[str, Objects]:
    """Return the objects of each frame of the data set, or of each image without `frame_ids`.

    With several cameras, images are those in a folder with the name of the camera.
    """
    of_camera = {name: each for name, each in found.items() if camera and _folder(name) == camera}
    found = of_camera or found
    if not len(frame_ids):
        # Images of one name belong to several cameras: which one is meant is then unknown.
        count = Counter(map(last_part, found))
        return {
            last_part(name): objects
            for name, objects in found.items()
            if count[last_part(name)] == 1
        }
    matched, unmatched = frame_ids.match(found, path)
    if unmatched and not matched:
        raise DataError(
            f"{path}: no image is of a frame of the data set, such as {unmatched[0][:200]!r}"
            f"{frame_ids.nearest(unmatched[0])}"
        )
    return {frame: found[name] for name, frame in matched.items()}


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
