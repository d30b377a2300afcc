"""The columns of an exported weighted label, with their units and meanings."""

from dataclasses import replace

from curate.priors.base import Column
from curate.priors.points import PointPrior
from curate.priors.semantic import SemanticPrior


def as_optional(columns: tuple[Column, ...]) -> tuple[Column, ...]:
    """Return evidence columns for labels: a label may lack the evidence, then they are null."""
    return tuple(replace(column, optional=True) for column in columns)


WEIGHTED_LABELS = (
    Column("round", "int32", "", "round that made the label"),
    Column("frame", "name", "", "frame id"),
    Column("k", "int32", "", "number of the label within its frame, by falling score"),
    Column("category", "name", "", "category of the object"),
    Column("x", "float64", "m", "box centre, forward of the LiDAR"),
    Column("y", "float64", "m", "box centre, left of the LiDAR"),
    Column("z", "float64", "m", "box centre, above the LiDAR"),
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
    Column("provenance", "name", "", "detector, or human if a person decided"),
    Column("policy", "name", "", "policy that weighted the label"),
    Column("weight", "float64", "1", "v, reliability in [0, 1]; the policy defines what 0 means"),
)
"""The core columns, in the order of every format."""
