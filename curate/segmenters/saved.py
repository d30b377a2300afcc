"""A segmenter that reads precomputed semantic maps: a PNG or .npy file per frame."""

import glob
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from curate.datasets.frame_names import files_by_frame
from curate.errors import ConfigError, DataError
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.ranges import AtLeastOne
from curate.segmenters.base import Segmenter, SemanticMap, image_size_of
from curate.segmenters.classes import CLASS_MAPS, checked_classes, describe_unexpected_ids
from curate.segmenters.colours import COLOUR_TABLES, colour_table, ids_of_colours
from curate.segmenters.map_files import MapFile, read_map

_MAX_CLASSES = 256
_SUFFIXES = (".png", ".npy")
_PATTERNS = tuple(f"*{suffix}" for suffix in _SUFFIXES)
Channel = Literal["red", "green", "blue"]
_CHANNELS = get_args(Channel)
# What a value below the divisor is, where a published format defines it: a class without
# instances in Cityscapes' instanceIds, an instance of class 0 in KITTI's semantic instances.
_BELOW = {1000: "class", 256: "instance"}


class SavedSegmenter(Segmenter):
    """A `Segmenter` that reads DIRECTORY/FRAME.png or FRAME.npy.

    A value is a class id: a grey value, or an index into the palette of the PNG. Other meanings are
    declared, because no file states them.

    Args:
        directory: the folder of the maps, or of folders CAMERA of maps for several cameras; if
            no map is in it, they are in its subfolders.
        classes: the class ids that count for each category.
        divisor: for maps of class * divisor + instance number: 1000 for Cityscapes' instanceIds,
            256 for KITTI's. 1 for class ids in 16 bits, which could be either.
        below: what a value below the divisor is: a "class" id without an instance, or an "instance"
            of class 0. Not needed for the divisors above.
        colours: for maps that show classes in colours: the name of a colour table, or the colour
            [red, green, blue] of each class id. "none": the palette of a PNG has no meaning.
        channel: for maps in colours with the class id in one channel: "red" for CARLA's.
        frame_ids: the frames of the data set, with which the names of the maps are matched in the
            spellings of `curate.datasets.frame_names`; without them, names are frame ids.

    Raises:
        DataError: if the folder does not exist, or no map is of a frame of the data set.
        ConfigError: if a class id or another option is invalid.
    """

    needs_image = False
    needs_points = False

    def __init__(
        self,
        directory: StrPath,
        classes: Mapping[str, Sequence[int]],
        *,
        divisor: AtLeastOne | None = None,
        below: Literal["class", "instance"] | None = None,
        colours: str | Mapping[str, Sequence[int]] | None = None,
        channel: Channel | None = None,
        frame_ids: Sequence[str] = (),
    ) -> None:
        if divisor is not None and not (type(divisor) is int and divisor >= 1):
            raise ConfigError(
                f"segmenter.options.divisor {divisor!r}: expected an integer of at least 1"
            )
        if below not in {None, "class", "instance"}:
            raise ConfigError(f"segmenter.options.below {below!r}: use class or instance")
        if channel not in {None, *_CHANNELS}:
            raise ConfigError(
                f"segmenter.options.channel {channel!r}: use one of {', '.join(_CHANNELS)}"
            )
        self._table = None if colours in (None, "none") else colour_table(colours)
        if [divisor, self._table, channel].count(None) < 2:
            raise ConfigError("segmenter: declare only one of divisor, colours and channel")
        self.directory = Path(directory)
        self.classes = checked_classes(classes)
        self.divisor = divisor
        self.channel = channel
        self._below = below or _BELOW.get(divisor or 0)
        self._ignores_palette = colours == "none"
        if not self.directory.is_dir():
            raise DataError(f"{self.directory}: no such folder of semantic maps")
        self._frame_ids = frame_ids
        self._found: dict[str, Mapping[str, Path]] = {}
        if any(path.suffix.lower() in _SUFFIXES for path in self.directory.iterdir()):
            self._maps("")

    def _maps(self, camera: str) -> Mapping[str, Path]:
        """Return the map of each frame from a camera; "" for the only one."""
        if camera not in self._found:
            folder = self.directory / camera
            self._found[camera] = files_by_frame(folder, _PATTERNS, self._frame_ids)
        return self._found[camera]

    def segment(self, frame: Frame) -> SemanticMap:
        """Return the frame's saved map.

        Raises:
            DataError: if the map is missing, has another size than the frame's image, can be read
                in two ways, or contains ids that its class set does not have.
        """
        path = self._path(frame)
        class_ids = self._class_ids(path, read_map(path))
        width, height = image_size_of(frame)
        if class_ids.shape != (height, width):
            raise DataError(
                f"{path}: the map is {class_ids.shape[1]} x {class_ids.shape[0]} pixels, "
                f"the image of the frame is {width} x {height}"
            )
        if problem := describe_unexpected_ids(class_ids, self.classes):
            raise DataError(f"{path}: {problem}")
        return SemanticMap(class_ids, self.classes)

    def _path(self, frame: Frame) -> Path:
        """Return the file of the map of a frame from its camera."""
        folder, name = self.directory / frame.camera, frame.frame_id
        matched = self._maps(frame.camera)
        if name in matched:
            return matched[name]
        paths = [folder / f"{name}{suffix}" for suffix in _SUFFIXES]
        found = [path for path in paths if path.exists()]
        if len(found) > 1:
            raise DataError(f"{found[0]}: {found[1].name} is a map of the same frame; remove one")
        lossy = list(folder.glob(f"{glob.escape(name)}.jp*g"))
        return (found or lossy or paths)[0]

    def _class_ids(self, path: Path, content: MapFile) -> np.ndarray:
        """Return the (h, w) uint8 class ids of a map's file."""
        values, palette = content.values, content.palette
        if self._table is not None:
            return self._ids_of_colours(path, values if palette is None else palette[values])
        if self.channel is not None and values.ndim == 3:
            values = values[:, :, _CHANNELS.index(self.channel)]
        elif values.ndim == 3:
            names = ", ".join(COLOUR_TABLES)
            raise DataError(
                f"{path}: a map in colours; if each class has a colour, set segmenter.options."
                f"colours to one of {names} or to a table, if one channel is the class id, set "
                "segmenter.options.channel"
            )
        if palette is not None:
            self._check_palette(path, values, palette)
        return self._ids_of_values(path, values)

    def _ids_of_values(self, path: Path, values: np.ndarray) -> np.ndarray:
        """Return the class ids of (h, w) integers."""
        divisor = self.divisor
        if divisor is None and values.dtype == np.uint16:
            raise DataError(
                f"{path}: values of 16 bits can be class ids, or class * divisor + instance; set "
                "segmenter.options.divisor: 1 for class ids, 1000 for Cityscapes' instanceIds, 256 "
                "for KITTI's"
            )
        if values.dtype.kind == "i" and values.min(initial=0) < 0:
            raise DataError(f"{path}: contains {values.min()}, a class id is at least 0")
        if divisor is not None and divisor > 1:
            small = (values < divisor) & (values > 0)
            if small.any() and self._below is None:
                value = int(values[small][0])
                raise DataError(
                    f"{path}: contains {value}, which can be class {value} without an instance, or "
                    f"instance {value} of class 0; set segmenter.options.below to class or instance"
                )
            quotient = values // divisor
            values = np.where(small, values, quotient) if self._below == "class" else quotient
        if values.max(initial=0) >= _MAX_CLASSES:
            raise DataError(
                f"{path}: class {values.max()} with divisor {divisor or 1}, expected 0 to "
                f"{_MAX_CLASSES - 1}; check segmenter.options.divisor"
            )
        return values.astype(np.uint8)

    def _ids_of_colours(self, path: Path, pixels: np.ndarray) -> np.ndarray:
        """Return the class ids of (h, w, 3) colours."""
        if pixels.ndim != 3 or pixels.dtype != np.uint8:
            raise DataError(
                f"{path}: has no colours of 8 bits; remove segmenter.options.colours if its values "
                "are class ids"
            )
        ids = ids_of_colours(pixels, self._table or {})
        if ids.min(initial=0) < 0:
            row, column = np.argwhere(ids < 0)[0].tolist()
            raise DataError(
                f"{path}: the colour {pixels[row, column, :3].tolist()} in row {row}, column "
                f"{column} is not in the table of segmenter.options.colours"
            )
        return ids.astype(np.uint8)

    def _check_palette(self, path: Path, values: np.ndarray, palette: np.ndarray) -> None:
        """Raise DataError if the palette shows the colours of the class set in another order.

        A map in colours that was saved with a palette of its own has indices without a meaning.
        """
        names = [name for name in COLOUR_TABLES if CLASS_MAPS[name] == self.classes]
        if self._ignores_palette or not names:
            return
        used = np.unique(values)
        ids = ids_of_colours(palette[used], COLOUR_TABLES[names[0]])
        if (ids >= 0).all() and (ids != used).any():
            index, other = used[ids != used][0], ids[ids != used][0]
            raise DataError(
                f"{path}: index {index} of the palette can be class {index}, or class {other} of "
                f"{names[0]} by its colour; set segmenter.options.colours to none or {names[0]}"
            )
