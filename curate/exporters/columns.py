"""What an exported weighted label says of itself: its columns, their units and their meanings."""

from dataclasses import replace

from curate.priors.base import Column
from curate.priors.points import PointPrior
from curate.priors.semantic import SemanticPrior


def as_optional(columns: tuple[Column, ...]) -> tuple[Column, ...]:
    """Return columns of evidence as a label has them: null where there is no such evidence."""
    return tuple(replace(column, optional=True) for column in columns)


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
    *as_optional(PointPrior.columns),
    *as_optional(SemanticPrior.columns),
    Column("rho_det", "float64", "1", "product of the priors' rho", True),
    Column("lambda_u", "float64", "1", "age parameter, Eq. 4: losses above it weigh 0", True),
    Column("provenance", "name", "", "detector, or human where a person decided"),
    Column("policy", "name", "", "that weighted the label"),
    Column("weight", "float64", "1", "v, reliability in [0, 1]; what 0 means, the policy says"),
)
"""The core columns, in the order in which every format has them."""
