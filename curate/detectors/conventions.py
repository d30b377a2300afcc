"""How other frameworks write a box, and its conversion to centre, length, width, height, yaw."""

from dataclasses import dataclass

import numpy as np

from curate.errors import ConfigError
from curate.geometry.similarity import wrap_angle

_ORIGINS = ("centre", "bottom")
_ORDERS = ("lwh", "wlh", "hwl", "lhw", "whl", "hlw")
_YAW_AXES = ("x", "y")


@dataclass(frozen=True)
class BoxConvention:
    """What the seven numbers x, y, z, three sizes, yaw of a box in the LiDAR frame mean.

    Attributes:
        origin: x, y, z is the "centre" of the box or of its "bottom".
        order: of the sizes, e.g. "wlh".
        yaw_axis: the axis along which an object of yaw 0 points, "x" or "y".
        yaw_sign: 1 where yaw grows counter-clockwise seen from above, -1 otherwise.
        yaw_offset_rad: added last, radians.

    Raises:
        ConfigError: a value is none of these.
    """

    origin: str = "centre"
    order: str = "lwh"
    yaw_axis: str = "x"
    yaw_sign: int = 1
    yaw_offset_rad: float = 0.0

    def __post_init__(self) -> None:
        choices = {"origin": _ORIGINS, "order": _ORDERS, "yaw_axis": _YAW_AXES, "yaw_sign": (1, -1)}
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                known = ", ".join(map(str, allowed))
                raise ConfigError(f"box convention {name} {getattr(self, name)!r}: use {known}")

    def to_boxes(self, written: np.ndarray) -> np.ndarray:
        """(n, 7) boxes at their centre with length, width, height and yaw from (n, >=7) rows."""
        boxes = np.array(written[:, :7], dtype=np.float64)
        boxes[:, 3:6] = boxes[:, [3 + self.order.index(size) for size in "lwh"]]
        if self.origin == "bottom":
            boxes[:, 2] += boxes[:, 5] / 2
        quarter = np.pi / 2 if self.yaw_axis == "y" else 0.0
        boxes[:, 6] = wrap_angle(self.yaw_sign * boxes[:, 6] + quarter + self.yaw_offset_rad)
        return boxes
