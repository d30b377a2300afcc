"""Colour tables of semantic maps that show each class in a colour.

Sources: the tables of Cityscapes, of Pascal VOC (a colour for each of 256 ids, bit by bit), and of
CamVid's eleven classes as used by SegNet (Badrinarayanan et al. 2017).
"""

from collections.abc import Mapping, Sequence

import numpy as np

from curate.errors import ConfigError
from curate.spelling import did_you_mean

_UNLABELED = 255
# Label id, train id or 255, and colour of Cityscapes' classes. Where two share a colour (pole and
# pole group), the one with a train id comes first and is taken.
_CITYSCAPES = (
    (7, 0, (128, 64, 128)), (8, 1, (244, 35, 232)), (11, 2, (70, 70, 70)),
    (12, 3, (102, 102, 156)), (13, 4, (190, 153, 153)), (17, 5, (153, 153, 153)),
    (19, 6, (250, 170, 30)), (20, 7, (220, 220, 0)), (21, 8, (107, 142, 35)),
    (22, 9, (152, 251, 152)), (23, 10, (70, 130, 180)), (24, 11, (220, 20, 60)),
    (25, 12, (255, 0, 0)), (26, 13, (0, 0, 142)), (27, 14, (0, 0, 70)), (28, 15, (0, 60, 100)),
    (31, 16, (0, 80, 100)), (32, 17, (0, 0, 230)), (33, 18, (119, 11, 32)),
    (0, 255, (0, 0, 0)), (5, 255, (111, 74, 0)), (6, 255, (81, 0, 81)), (9, 255, (250, 170, 160)),
    (10, 255, (230, 150, 140)), (14, 255, (180, 165, 180)), (15, 255, (150, 100, 100)),
    (16, 255, (150, 120, 90)), (29, 255, (0, 0, 90)), (30, 255, (0, 0, 110)),
)  # fmt: skip
_CAMVID = (
    (128, 128, 128), (128, 0, 0), (192, 192, 128), (128, 64, 128), (60, 40, 222), (128, 128, 0),
    (192, 128, 128), (64, 64, 128), (64, 0, 128), (64, 64, 0), (0, 128, 192),
)  # fmt: skip


def _voc_colour(class_id: int) -> tuple[int, ...]:
    """Return the colour of a class: its bits 0, 3, 6 form the highest bits of red, and so on."""
    return tuple(
        sum(((class_id >> (3 * bit + channel)) & 1) << (7 - bit) for bit in range(3))
        for channel in range(3)
    )


ColourTable = Mapping[tuple[int, ...], int]
"""Class id of each colour (red, green, blue)."""

COLOUR_TABLES: Mapping[str, ColourTable] = {
    "camvid": {(0, 0, 0): _UNLABELED, **{colour: i for i, colour in enumerate(_CAMVID)}},
    "cityscapes": {colour: train_id for _, train_id, colour in _CITYSCAPES},
    "cityscapes-label-ids": {colour: label_id for label_id, _, colour in _CITYSCAPES},
    "voc": {_voc_colour(i): i for i in (*range(21), _UNLABELED)},
}


def colour_table(colours: str | Mapping[str, Sequence[int]]) -> ColourTable:
    """Return the class id of each colour.

    Args:
        colours: a name in `COLOUR_TABLES`, or the colour (red, green, blue) of each class id.

    Raises:
        ConfigError: if there is no table of that name, or an id or a colour is invalid.
    """
    if isinstance(colours, str):
        if colours not in COLOUR_TABLES:
            names = ", ".join(COLOUR_TABLES)
            hint = did_you_mean(colours, COLOUR_TABLES)
            raise ConfigError(
                f"segmenter.options.colours {colours!r}: use {names} or a table{hint}"
            )
        return COLOUR_TABLES[colours]
    table: dict[tuple[int, ...], int] = {}
    for class_id, colour in colours.items():
        valid = isinstance(colour, Sequence) and len(colour) == 3
        if not (valid and all(isinstance(part, int) and 0 <= part <= 255 for part in colour)):
            raise ConfigError(
                f"segmenter.options.colours: {colour!r} is not a colour like [0, 0, 142]"
            )
        if not (str(class_id).isdecimal() and int(class_id) <= 255):
            raise ConfigError(
                f"segmenter.options.colours: {class_id!r} is not a class id from 0 to 255"
            )
        if tuple(colour) in table:
            raise ConfigError(
                f"segmenter.options.colours: two classes have the colour {list(colour)}"
            )
        table[tuple(colour)] = int(class_id)
    return table


def ids_of_colours(pixels: np.ndarray, table: ColourTable) -> np.ndarray:
    """Return the (...) class ids of (..., 3) uint8 colours; -1 for a colour outside the table."""
    codes = _codes(pixels)
    known = np.array(list(table), dtype=np.uint8).reshape(-1, 3)
    order = np.argsort(_codes(known))
    sorted_codes = _codes(known)[order]
    ids = np.array(list(table.values()), dtype=np.int64)[order]
    place = np.searchsorted(sorted_codes, codes).clip(0, len(ids) - 1)
    return np.asarray(np.where(sorted_codes[place] == codes, ids[place], -1))


def _codes(pixels: np.ndarray) -> np.ndarray:
    """Return each colour as one number."""
    red, green, blue = np.moveaxis(pixels[..., :3].astype(np.uint32), -1, 0)
    codes: np.ndarray = red << 16 | green << 8 | blue
    return codes
