"""What an exported weighted label says of itself: its columns, their units and their meanings."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Column:
    """One column of the weighted labels.

    Attributes:
        name: of the column.
        kind: type of its values: "name", "int32", "int64" or "float64".
        unit: "m", "rad", "px", "1" for a number without unit, "" for what is no quantity.
        meaning: in a few words, with the symbol and equation of the paper.
        optional: whether it is null where there is no evidence.
    """

    name: str
    kind: str
    unit: str
    meaning: str
    optional: bool = False


WEIGHTED_LABELS = (
    Column("round", "int32", "", "round that made the label"),
    Column("frame", "name", "", "frame id"),
    Column("k", "int32", "", "number of the label within its frame, by falling score"),
    Column("category", "name", "", "of the object"),
    Column("x", "float64", "m", "box centre, forward of the LiDAR"),
    Column("y", "float64", "m", "box centre, to its left"),
    Column("z", "float64", "m", "box centre, above it"),
    Column("length", "float64", "m", "along the heading"),
    Column("width", "float64", "m", "across the heading"),
    Column("height", "float64", "m", "upward"),
    Column("yaw", "float64", "rad", "counter-clockwise from x, in (-pi, pi]"),
    Column("score", "float64", "1", "s of the detector, in [0, 1]"),
    Column("loss", "float64", "1", "consistency loss L; null without a matched reprediction", True),
    Column("points", "int32", "1", "m, LiDAR points in the box", True),
    Column(
        "points_threshold", "float64", "1", "m_th, what labeled boxes of the category hold", True
    ),
    Column("rho_diff", "float64", "1", "point prior, Eq. 8: min(m, m_th) / m_th", True),
    Column("mask_pixels", "int64", "px", "S, pixels of the category in the projected box", True),
    Column("box_pixels", "int64", "px", "A, pixels of the projected box", True),
    Column("rho_anno", "float64", "1", "semantic prior, Eq. 9, from s, S and A", True),
    Column("rho_det", "float64", "1", "rho_diff * rho_anno", True),
    Column("lambda_u", "float64", "1", "age parameter, Eq. 4: losses above it weigh 0", True),
    Column("provenance", "name", "", "detector, or human where a person decided"),
    Column("policy", "name", "", "that weighted the label"),
    Column("weight", "float64", "1", "v, reliability in [0, 1]; what 0 means, the policy says"),
)
"""The core columns, in the order in which every format has them."""
