"""A folder of stored semantic maps: each is made once, and read whenever it is needed again.

The names of folder and file are hashes of everything that the map depends on:

    maps/7c1f0a22b3d94e05/segmenter.json      what made the maps: segmenter, arguments, model
    maps/7c1f0a22b3d94e05/3e/3e97....gz       the map of the image file with this SHA-256

So a map of another model or of another image is never read, several processes and workspaces can
use one folder, and every process writes the same content. A file is in gzip's format, which has a
checksum that reveals damage. It contains a line of JSON (the two hashes, height, width, the class
ids of each category), then a byte per pixel, row by row.
"""

import gzip
import hashlib
import json
import os
import shutil
import time
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from curate.datasets.base import Dataset
from curate.datasets.formats.images import read_bytes
from curate.errors import DataError
from curate.files.atomic import replace_file
from curate.frames import Frame
from curate.segmenters.base import Segmenter, SemanticMap, image_size_of
from curate.warnings_once import warn_once

_GIB = 1 << 30
_LEVEL = 6  # of zlib: half the size of level 1, and decoded in less than a millisecond
_GZIP = 31  # zlib's code for a stream with gzip's header and checksum
_LONGEST_HEADER = 1 << 16
# Other processes write into the folder, too, so its files are counted again and again; in between
# passes this many times the time that the counting took.
_PAUSE = 20
# No map is stored on a disk with less free space, so that other files of the run still fit.
_SPARE_BYTES = 1 << 24
_DESCRIPTION = "segmenter.json"
_NOT_STORED = "maps that are not there are made again each time they are needed"


@dataclass
class MapStore:
    """The stored maps of one segmenter.

    Attributes:
        root: the folder of the maps of all segmenters.
        made_by: what the maps depend on besides the images, as plain types.
        limit_gib: no map is stored while the files in `root` take more than this, in GiB.
        unstored: number of maps that could not be stored.
    """

    root: Path
    made_by: Mapping[str, Any]
    limit_gib: float = float("inf")
    unstored: int = field(default=0, init=False)
    _bytes: int = field(default=0, init=False)
    _count_at: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        """Choose the segmenter's folder."""
        text = json.dumps(self.made_by, sort_keys=True, default=str)
        self._segmenter = hashlib.sha256(text.encode()).hexdigest()[:16]
        self.folder = self.root / self._segmenter

    def path(self, image: str) -> Path:
        """Return the file of the map of an image, given by the hash of its file."""
        return self.folder / image[:2] / f"{image}.gz"

    def read(self, image: str, size: tuple[int, int]) -> SemanticMap | None:
        """Return the stored map of an image; None if there is none that can be used.

        A damaged map, and one of another size than the image, is reported in a warning.

        Args:
            image: hash of the image's file.
            size: (width, height) of the image in pixels.
        """
        path = self.path(image)
        try:
            return self._unpack(path.read_bytes(), image, size)
        except FileNotFoundError:
            return None
        except OSError as error:
            reason = f"cannot be read: {error.strerror}"
        except DataError as error:
            reason = str(error)
        warn_once(f"{path}: {reason}; the map is made again")
        return None

    def write(self, image: str, semantic_map: SemanticMap) -> None:
        """Store the map of an image, unless it cannot be stored; then a warning says why."""
        reason = self.refusal()
        if not reason:
            content = self._pack(image, semantic_map)
            try:
                self.prepare()
                replace_file(self.path(image), content)
                self._bytes += len(content)
            except OSError as error:
                reason = f"{self.folder}: {error.strerror}"
        if reason:
            self.unstored += 1
            warn_once(f"{reason}; {_NOT_STORED}")

    def refusal(self) -> str:
        """Return why no further map can be stored; "" if one can."""
        if self._used_bytes() >= self.limit_gib * _GIB:
            limit = shown_size(self.limit_gib * _GIB)
            return (
                f"{self.root}: the stored semantic maps take {limit}, the limit "
                "segmenter.cache_limit: raise it in curate.toml, or delete the folders of "
                "segmenters that you no longer use (segmenter.json in each says which one)"
            )
        existing = next(each for each in (self.folder, *self.folder.parents) if each.exists())
        if not existing.is_dir():
            return f"{existing}: not a folder; set segmenter.cache to a folder for semantic maps"
        if not os.access(existing, os.W_OK):
            return f"{existing}: no permission to store semantic maps"
        if shutil.disk_usage(existing).free < _SPARE_BYTES:
            return f"{existing}: no space left for semantic maps; free some, or set segmenter.cache"
        return ""

    def exists(self) -> bool:
        """Return whether the segmenter's folder is there."""
        return (self.folder / _DESCRIPTION).exists()

    def prepare(self) -> None:
        """Make the segmenter's folder, with a file for people that says what made its maps."""
        if self.exists() or self.refusal():
            return
        text = json.dumps(self.made_by, sort_keys=True, default=str, indent=2)
        with suppress(OSError):  # then no map can be stored either, and a warning says so
            replace_file(self.folder / _DESCRIPTION, f"{text}\n".encode())

    def _used_bytes(self) -> int:
        """Return the size of all maps in the folder, of all segmenters."""
        start = time.monotonic()
        if start >= self._count_at:
            self._bytes = _size(self.root)
            end = time.monotonic()
            self._count_at = end + _PAUSE * (end - start)
        return self._bytes

    def _pack(self, image: str, semantic_map: SemanticMap) -> bytes:
        """Return the content of a map's file."""
        height, width = semantic_map.class_ids.shape
        header = {
            "segmenter": self._segmenter,
            "image": image,
            "height": height,
            "width": width,
            "classes": {
                name: [int(each) for each in ids]
                for name, ids in semantic_map.category_classes.items()
            },
        }
        content = json.dumps(header).encode() + b"\n" + semantic_map.class_ids.tobytes()
        return gzip.compress(content, _LEVEL, mtime=0)

    def _unpack(self, content: bytes, image: str, size: tuple[int, int]) -> SemanticMap:
        """Return the map in a file.

        Raises:
            DataError: if the content is damaged, or not the map of this segmenter and image.
        """
        width, height = size
        stream = zlib.decompressobj(_GZIP)
        try:
            text = stream.decompress(content, _LONGEST_HEADER + width * height)
            line, _, pixels = text.partition(b"\n")
            header = json.loads(line)
            stored = {name: header[name] for name in ("segmenter", "image", "height", "width")}
            classes = {name: tuple(ids) for name, ids in header["classes"].items()}
        except (zlib.error, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            raise DataError("is damaged") from None
        if (stored["segmenter"], stored["image"]) != (self._segmenter, image):
            raise DataError("is the map of another segmenter or image")
        if (stored["width"], stored["height"]) != size:
            raise DataError(
                f"has {stored['width']} x {stored['height']} pixels, the image {width} x {height}"
            )
        if not stream.eof or stream.unused_data or len(pixels) != width * height:
            raise DataError("is damaged")
        class_ids = np.frombuffer(pixels, dtype=np.uint8).reshape(height, width)
        return SemanticMap(class_ids, classes)


class StoringSegmenter(Segmenter):
    """A `Segmenter` that makes the map of an image once, and reads it from a folder afterwards.

    Args:
        segmenter: makes the maps; it has a `map_version`.
        store: the folder of the maps.
        dataset: has the images. An image is decoded only if its map is not stored.
    """

    needs_image = False
    needs_points = False

    def __init__(self, segmenter: Segmenter, store: MapStore, dataset: Dataset) -> None:
        self.segmenter = segmenter
        self.store = store
        self._dataset = dataset

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the frame's semantic map.

        Raises:
            DataError: if the image is missing or damaged.
            ModelError: if the segmenter raises it.
        """
        size = image_size_of(frame)
        path = self._image_path(frame)
        if path is None:
            return self.segmenter.segment(self._with_image(frame))
        image = hashlib.sha256(read_bytes(path)).hexdigest()
        if found := self.store.read(image, size):
            return found
        made = self.segmenter.segment(self._with_image(frame))
        if made.class_ids.shape == size[::-1] and made.class_ids.dtype == np.uint8:
            self.store.write(image, made)
        else:
            self.store.unstored += 1
        return made

    def _image_path(self, frame: Frame) -> Path | None:
        """Return the file of the image of a frame with one camera; None if it has none."""
        images = self._dataset.files(frame.frame_id).images
        if len(images) <= 1:
            return images[0] if images else None
        cameras = self._dataset.read(frame.frame_id, points=False).cameras
        names = [camera.name for camera in cameras]
        return images[names.index(frame.camera)] if len(names) == len(images) else None

    def _with_image(self, frame: Frame) -> Frame:
        """Return a frame with one camera with its image."""
        if frame.image is not None:
            return frame
        whole = self._dataset.read(frame.frame_id, points=False, image=True)
        return next(view for view in whole.views() if view.camera == frame.camera)


def shown_size(size: float) -> str:
    """Return a number of bytes as text: "20 GiB", "1.5 MiB", "700 bytes"."""
    for power, unit in ((30, "GiB"), (20, "MiB"), (10, "KiB")):
        if size >= 1 << power:
            return f"{size / (1 << power):.4g} {unit}"
    return f"{size:.0f} bytes"


def _size(folder: Path) -> int:
    """Return the bytes of all maps in a folder and its subfolders."""
    total = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            if not name.endswith(".gz"):
                continue
            try:
                total += (Path(parent) / name).stat().st_size
            except FileNotFoundError:  # another process has just renamed it
                continue
    return total
