"""What an exported weighted label says of itself: its columns, their units and their meanings."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Column:
    """One column of the weighted labels.

    Attributes:
        kind: type of its values: "name", "int32", "int64" or "float64".
        unit: "m", "rad", "px", "1" for a number without unit, "" for what is no quantity.
        meaning: in a few words, with the symbol and equation of the paper.
        optional: whether it is null where there is no evidence.
    """

    kind: str
    unit: str
    meaning: str
    optional: bool = False


WEIGHTED_LABELS: Mapping[str, Column] = {
    "round": Column("int32", "", "round that made the label"),
    "frame": Column("name", "", "frame id"),
    "k": Column("int32", "", "number of the label within its frame, by falling score"),
    "category": Column("name", "", "of the object"),
    "x": Column("float64", "m", "box centre, forward of the LiDAR"),
    "y": Column("float64", "m", "box centre, to its left"),
    "z": Column("float64", "m", "box centre, above it"),
    "length": Column("float64", "m", "along the heading"),
    "width": Column("float64", "m", "across the heading"),
    "height": Column("float64", "m", "upward"),
    "yaw": Column("float64", "rad", "counter-clockwise from x, in (-pi, pi]"),
    "score": Column("float64", "1", "s of the detector, in [0, 1]"),
    "loss": Column("float64", "1", "consistency loss L; null without a matched reprediction", True),
    "points": Column("int32", "1", "m, LiDAR points in the box", True),
    "points_threshold": Column(
        "float64", "1", "m_th, what labeled boxes of the category hold", True
    ),
    "rho_diff": Column("float64", "1", "point prior, Eq. 8: min(m, m_th) / m_th", True),
    "mask_pixels": Column("int64", "px", "S, pixels of the category in the projected box", True),
    "box_pixels": Column("int64", "px", "A, pixels of the projected box", True),
    "rho_anno": Column("float64", "1", "semantic prior, Eq. 9, from s, S and A", True),
    "rho_det": Column("float64", "1", "rho_diff * rho_anno", True),
    "lambda_u": Column("float64", "1", "age parameter, Eq. 4: losses above it weigh 0", True),
    "provenance": Column("name", "", "detector, or human where a person decided"),
    "policy": Column("name", "", "that weighted the label"),
    "weight": Column("float64", "1", "v, reliability in [0, 1]; 0: not to be learned as object"),
}
"""In the order in which every format has them."""
