"""Names of nuScenes' classes, and what they are called here.

Source: nuScenes' detection task (nuscenes.org): 23 general classes of annotations, of which 14 make
up the ten classes of the task; results name the ten.
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
"""The class of the task behind a general class; the other nine have none."""

CATEGORIES: Mapping[str, str] = MappingProxyType(
    {"car": "Car", "pedestrian": "Pedestrian", "bicycle": "Cyclist"}
)
"""What segmenters, priors and the evaluation here know by another name; a bicycle's box holds its
rider. The other classes keep their names."""


def category_of(general_name: str, rename: Mapping[str, str]) -> str:
    """Return the category of an annotation; classes outside the task keep their general name.

    Args:
        general_name: such as vehicle.car.
        rename: categories by name of the task's class.
    """
    name = DETECTION_NAMES.get(general_name, general_name)
    return rename.get(name, name)


def detection_name(category: str) -> str | None:
    """Return the task's class of a category under `CATEGORIES`, or None where it has none."""
    ours = {name: detected for detected, name in CATEGORIES.items()}
    name = ours.get(category, category)
    return name if name in DETECTION_NAMES.values() else None
