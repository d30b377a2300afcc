"""Which classes of a known segmentation data set count as pixels of a detection category.

A cyclist is rider and bicycle together; a pedestrian is a person on foot. Where a class set has one
class for all people, it counts for both. The numbers are those of each data set's own definition:
Pascal VOC's, Cityscapes' train ids, COCO's category ids with 0 as background, and COCO's 80 classes
counted from 0.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

from curate.errors import ConfigError
from curate.spelling import did_you_mean

if TYPE_CHECKING:
    import numpy as np

ClassMap = Mapping[str, tuple[int, ...]]

CLASS_MAPS: Mapping[str, ClassMap] = MappingProxyType(
    {
        "voc": {"Car": (7,), "Pedestrian": (15,), "Cyclist": (2, 15)},
        "cityscapes": {"Car": (13,), "Pedestrian": (11,), "Cyclist": (12, 18)},
        "cityscapes-label-ids": {"Car": (26,), "Pedestrian": (24,), "Cyclist": (25, 33)},
        "coco": {"Car": (3,), "Pedestrian": (1,), "Cyclist": (1, 2)},
        "coco-from-0": {"Car": (2,), "Pedestrian": (0,), "Cyclist": (0, 1)},
        "simulated": {"Car": (1,), "Pedestrian": (2,), "Cyclist": (3,)},
    }
)

# What maps of a class set can hold besides 255, "none of them"; COCO has several numberings.
_KNOWN_IDS = {
    "voc": range(21),
    "cityscapes": range(19),
    "cityscapes-label-ids": range(34),
    "simulated": range(4),
}
_UNLABELED = 255


def class_map(name: str) -> ClassMap:
    """Return the classes of each category in a known class set.

    Raises:
        ConfigError: if the class set is not known.
    """
    if name not in CLASS_MAPS:
        known = ", ".join(sorted(CLASS_MAPS))
        meant = did_you_mean(name, CLASS_MAPS)
        raise ConfigError(f"unknown class set {name!r}: use one of {known}{meant}")
    return CLASS_MAPS[name]


def checked_classes(classes: Mapping[str, Sequence[int]]) -> ClassMap:
    """Return a class map as the user gave it, with tuples of ids.

    Raises:
        ConfigError: if an id is no integer from 0 to 255.
    """
    for category, ids in classes.items():
        for one in ids:
            if not isinstance(one, int) or not 0 <= one <= 255:
                raise ConfigError(f"segmenter class {one!r} of {category}: an id is 0 to 255")
    return {category: tuple(ids) for category, ids in classes.items()}


def free_id(classes: ClassMap) -> int:
    """Return a class id for the pixels of nothing: 0, unless that counts for a category."""
    wanted = {one for ids in classes.values() for one in ids}
    return next((one for one in range(256) if one not in wanted), 0)


def foreign_ids(class_ids: "np.ndarray", classes: ClassMap) -> str | None:
    """What is wrong with (h, w) class ids that the declared class set does not have, else None."""
    import numpy as np

    for name, known in _KNOWN_IDS.items():
        if CLASS_MAPS[name] != classes:
            continue
        strange = np.setdiff1d(class_ids, [*known, _UNLABELED])
        if len(strange):
            fault = f"holds class {strange[0]}, but the classes of {name} are 0 to {known[-1]}"
            others = [
                other
                for other, ids in _KNOWN_IDS.items()
                if not len(np.setdiff1d(class_ids, [*ids, _UNLABELED]))
            ]
            hint = f"; are they {' or '.join(others)}? See segmenter.classes" if others else ""
            return fault + hint
    return None
