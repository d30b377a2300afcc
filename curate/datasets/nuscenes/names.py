"""The class names of nuScenes and their categories in curate.

Source: nuScenes' detection task (nuscenes.org). Annotations have 23 general classes. 14 of them
form the ten classes of the detection task, which result files use.
"""

from collections.abc import Mapping
from types import MappingProxyType

DETECTION_NAMES: Mapping[str, str] = MappingProxyType(
    {
        "human.pedestrian.adult": "pedestrian",
        "human.pedestrian.child": "pedestrian",
        "human.pedestrian.construction_worker": "pedestrian",
        "human.pedestrian.police_officer": "pedestrian",
        "movable_object.barrier": "barrier",
        "movable_object.trafficcone": "traffic_cone",
        "vehicle.bicycle": "bicycle",
        "vehicle.bus.bendy": "bus",
        "vehicle.bus.rigid": "bus",
        "vehicle.car": "car",
        "vehicle.construction": "construction_vehicle",
        "vehicle.motorcycle": "motorcycle",
        "vehicle.trailer": "trailer",
        "vehicle.truck": "truck",
    }
)
"""The class of the detection task for each general class; the other nine have none."""

CATEGORIES: Mapping[str, str] = MappingProxyType(
    {"car": "Car", "pedestrian": "Pedestrian", "bicycle": "Cyclist"}
)
"""The category for each class of the task; other classes keep their names. A bicycle is a Cyclist
because its box includes the rider."""


def category_of(general_name: str, rename: Mapping[str, str]) -> str:
    """Return the category of an annotation; classes outside the task keep their general name.

    Args:
        general_name: general class, such as vehicle.car.
        rename: the category for each class of the task, as in `CATEGORIES`.
    """
    name = DETECTION_NAMES.get(general_name, general_name)
    return rename.get(name, name)


def detection_name(category: str) -> str | None:
    """Return the task's class for a category (the inverse of `CATEGORIES`), or None."""
    class_of = {name: task_class for task_class, name in CATEGORIES.items()}
    name = class_of.get(category, category)
    return name if name in DETECTION_NAMES.values() else None
