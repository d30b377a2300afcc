"""Which classes of a known segmentation data set count as pixels of a detection category.

A cyclist is rider and bicycle together; a pedestrian is a person on foot. Where a class set has one
class for all people, it counts for both. The numbers are those of each data set's own definition:
Pascal VOC's, Cityscapes' train ids, and COCO's category ids with 0 as background.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from curate.errors import ConfigError

ClassMap = Mapping[str, tuple[int, ...]]

CLASS_MAPS: Mapping[str, ClassMap] = MappingProxyType(
    {
        "voc": {"Car": (7,), "Pedestrian": (15,), "Cyclist": (2, 15)},
        "cityscapes": {"Car": (13,), "Pedestrian": (11,), "Cyclist": (12, 18)},
        "coco": {"Car": (3,), "Pedestrian": (1,), "Cyclist": (1, 2)},
        "simulated": {"Car": (1,), "Pedestrian": (2,), "Cyclist": (3,)},
    }
)


def class_map(name: str) -> ClassMap:
    """The classes of each category in a known class set.

    Raises:
        ConfigError: the class set is not known.
    """
    if name not in CLASS_MAPS:
        known = ", ".join(sorted(CLASS_MAPS))
        raise ConfigError(f"unknown class set {name!r}: use one of {known}")
    return CLASS_MAPS[name]


def checked_classes(classes: Mapping[str, Sequence[int]]) -> ClassMap:
    """A class map as the user gave it, with tuples of ids.

    Raises:
        ConfigError: an id is no integer from 0 to 255.
    """
    for category, ids in classes.items():
        for one in ids:
            if not isinstance(one, int) or not 0 <= one <= 255:
                raise ConfigError(f"segmenter class {one!r} of {category}: an id is 0 to 255")
    return {category: tuple(ids) for category, ids in classes.items()}
