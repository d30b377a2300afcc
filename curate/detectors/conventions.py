"""Box conventions of other frameworks and their conversion to centre, size and yaw."""

from dataclasses import dataclass

import numpy as np

from curate.errors import ConfigError
from curate.geometry.similarity import wrap_angle

_ORIGINS = ("centre", "bottom")
_ORDERS = ("lwh", "wlh", "hwl", "lhw", "whl", "hlw")
_YAW_AXES = ("x", "y")


@dataclass(frozen=True)
class BoxConvention:
    """Meaning of the seven numbers x, y, z, three sizes, yaw of a box in the LiDAR frame.

    Attributes:
        origin: whether x, y, z is the "centre" of the box or the centre of its "bottom".
        order: order of the sizes, e.g. "wlh".
        yaw_axis: the axis along which an object of yaw 0 points, "x" or "y".
        yaw_sign: 1 if yaw grows counter-clockwise seen from above, -1 if clockwise.
        yaw_offset_rad: added last, in radians.

    Raises:
        ConfigError: if an attribute has another value.
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
                choice = ", ".join(map(str, allowed))
                raise ConfigError(f"box convention {name} {getattr(self, name)!r}: use {choice}")

    def to_boxes(self, rows: np.ndarray) -> np.ndarray:
        """Return (n, 7) boxes x, y, z, length, width, height, yaw at the box centre.

        Args:
            rows: (n, >=7) numbers in this convention; further columns are ignored.
        """
        boxes = np.array(rows[:, :7], dtype=np.float64)
        boxes[:, 3:6] = boxes[:, [3 + self.order.index(size) for size in "lwh"]]
        if self.origin == "bottom":
            boxes[:, 2] += boxes[:, 5] / 2
        axis_yaw = np.pi / 2 if self.yaw_axis == "y" else 0.0
        boxes[:, 6] = wrap_angle(self.yaw_sign * boxes[:, 6] + axis_yaw + self.yaw_offset_rad)
        return boxes
