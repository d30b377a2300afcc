"""The built-in class sets: which classes of a segmentation data set count for which category.

A cyclist is the rider and the bicycle; a pedestrian is a person on foot. If a class set has one
class for all people, it counts for both. The ids are those that each data set defines: the classes
of Pascal VOC, the train ids or label ids of Cityscapes, CamVid's eleven classes, the category ids
of COCO with 0 as background, and the 80 classes of COCO counted from 0.
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
        "camvid": {"Car": (8,), "Pedestrian": (9,), "Cyclist": (10,)},
        "simulated": {"Car": (1,), "Pedestrian": (2,), "Cyclist": (3,)},
    }
)

# The ids that maps of a class set may contain, besides 255 (unlabeled). COCO is not checked: it has
# several numberings.
_VALID_IDS = {
    "voc": range(21),
    "cityscapes": range(19),
    "cityscapes-label-ids": range(34),
    "camvid": range(11),
    "simulated": range(4),
}
_UNLABELED = 255


def class_map(name: str) -> ClassMap:
    """Return the class ids of each category in a built-in class set.

    Raises:
        ConfigError: if there is no class set of that name.
    """
    if name not in CLASS_MAPS:
        names = ", ".join(sorted(CLASS_MAPS))
        suggestion = did_you_mean(name, CLASS_MAPS)
        raise ConfigError(f"unknown class set {name!r}: use one of {names}{suggestion}")
    return CLASS_MAPS[name]


def checked_classes(classes: Mapping[str, Sequence[int]]) -> ClassMap:
    """Return the user's class map with the ids of each category as a tuple.

    Raises:
        ConfigError: if an id is not an integer from 0 to 255.
    """
    for category, ids in classes.items():
        for class_id in ids:
            if not isinstance(class_id, int) or not 0 <= class_id <= 255:
                raise ConfigError(
                    f"segmenter class {class_id!r} of {category}: an id is an integer from 0 to 255"
                )
    return {category: tuple(ids) for category, ids in classes.items()}


def missing_classes(segmenter: str) -> ConfigError:
    """Return the error for a segmenter with class ids that have no configured category."""
    return ConfigError(
        f"segmenter '{segmenter}': the meaning of its class ids is not configured: set "
        f"segmenter.classes (at init: --segmenter-classes) to one of {', '.join(CLASS_MAPS)}, or "
        "segmenter.options.classes to a table like {Car = [7]}"
    )


def background_id(classes: ClassMap) -> int:
    """Return a class id for background pixels: the lowest that counts for no category, or 0."""
    used = {class_id for ids in classes.values() for class_id in ids}
    return next((class_id for class_id in range(256) if class_id not in used), 0)


def describe_unexpected_ids(class_ids: "np.ndarray", classes: ClassMap) -> str | None:
    """Return an error text if (h, w) class ids are not of the declared class set, else None."""
    import cv2
    import numpy as np

    present: set[int] | None = None
    for name, valid in _VALID_IDS.items():
        if CLASS_MAPS[name] != classes:
            continue
        if present is None:
            # A hundredth of the time of np.unique.
            counts = cv2.calcHist([np.ascontiguousarray(class_ids)], [0], None, [256], [0, 256])
            present = set(np.flatnonzero(counts).tolist())
        unexpected = sorted(present - {*valid, _UNLABELED})
        if unexpected:
            problem = (
                f"contains class {unexpected[0]}, but the classes of {name} are 0 to {valid[-1]}"
            )
            candidates = [
                candidate for candidate, ids in _VALID_IDS.items() if present <= {*ids, _UNLABELED}
            ]
            if not candidates:
                return problem
            return f"{problem}; if the map uses {' or '.join(candidates)}, set segmenter.classes"
    return None
