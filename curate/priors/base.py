"""Interfaces of evidence sources: sources of a frame and sources of a sequence.

A source declares its columns once, with type, unit and meaning. Its table, the columns of
`weighted_labels` and of every export, explanations and reports follow from this declaration.
"""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np

from curate.detections import Detections
from curate.errors import ConfigError, DataError
from curate.frames import Frame
from curate.shapes import Float

KINDS = ("int32", "int64", "float64", "name")
_NAME = re.compile(r"[a-z][a-z0-9_]*")


@dataclass(frozen=True)
class Column:
    """One column of evidence, or of the weighted labels.

    Attributes:
        name: name of the column.
        kind: type of its values, one of `KINDS`.
        unit: "m", "rad", "px", "1" for a number without unit, "" if it is not a quantity.
        meaning: short description, with the symbol and equation of the paper.
        optional: whether a value may be null, for a label without evidence.
    """

    name: str
    kind: str
    unit: str
    meaning: str
    optional: bool = False


Measured = Mapping[str, np.ndarray]
"""(n,) arrays of n labels, keyed by `EvidenceSource.measured_columns`."""
Evidence = Mapping[str, np.ndarray]
"""(n,) arrays of n labels, keyed by the names of a source's columns."""


class EvidenceDeclaration(Protocol):
    """Class attributes that every evidence source declares."""

    name: ClassVar[str]
    """Name of the source; its evidence is stored under this name."""
    columns: ClassVar[tuple[Column, ...]]
    """All columns that the source stores for a label."""
    rho_column: ClassVar[str | None] = None
    """The column with a prior's trust rho in [0, 1]; rho_det is the product over the priors."""
    further_columns: ClassVar[tuple[Column, ...]] = ()
    """Columns that only some workspaces have, such as those with several cameras; of sources with a
    table of the schema."""


class EvidenceSource(EvidenceDeclaration, Protocol):
    """Independent evidence for the labels of one frame. Sources inherit from this class.

    A source works in two steps. `measure` reads the sensor data, which may be slow. `rate` computes
    the evidence from the measurements. A changed formula in `rate` needs no new measurement.

    The pipeline passes these arguments to a constructor that has parameters with these names:
    `segmenter` (None if nothing will be measured), `thresholds` (points per category, learned from
    X_l), `references` (S/A per category, learned from X_l, if `semantic.reference` is true), and
    the user's options.
    """

    measured_columns: ClassVar[tuple[str, ...]]
    """The columns that `measure` returns."""

    @property
    def needs_points(self) -> bool:
        """Return whether `measure` reads `frame.points`."""
        return True

    @property
    def needs_image(self) -> bool:
        """Return whether `measure` reads `frame.image`."""
        return False

    def measure(self, frame: Frame, detections: Detections) -> Measured:
        """Return the measured columns of the frame's detections, in the order of detections."""
        ...

    def rate(self, detections: Detections, measured: Measured) -> Evidence:
        """Return all columns of evidence, computed from the measured columns."""
        ...

    def score(self, frame: Frame, detections: Detections) -> Evidence:
        """Measure and rate the frame's detections; return all columns of evidence."""
        return self.rate(detections, self.measure(frame, detections))

    def describe(self, row: Mapping[str, Any]) -> str:
        """Return a line that explains the stored columns of one label, formatted for reading."""
        return ", ".join(f"{column.name} = {row[column.name]}" for column in self.columns)


@dataclass(frozen=True)
class SequenceFrame:
    """A frame of a sequence.

    Attributes:
        frame_id: id of the frame.
        detections: the labels of the frame, in the order of k.
        read: reads the frame with its points; for sources that need more than the labels.
        time_s: time of the sweep in seconds; None if the data set has no timestamps.
        pose: (4, 4) pose of the LiDAR in a map frame; None if the data set has no poses.
    """

    frame_id: str
    detections: Detections
    read: Callable[[], Frame]
    time_s: float | None = None
    pose: Float[np.ndarray, "4 4"] | None = None


class SequenceSource(EvidenceDeclaration, Protocol):
    """Evidence from all frames of a sequence, such as tracks. Sources inherit from this class."""

    def check_frame(self, frame_id: str, time_s: float | None) -> None:
        """Raise DataError if a frame of a sequence cannot be used; called before any work."""

    def score_sequence(self, frames: Sequence[SequenceFrame]) -> Sequence[Evidence]:
        """Return the evidence of each frame's labels, in the order of the frames."""
        ...

    def describe(self, row: Mapping[str, Any]) -> str:
        """Return a line that explains the stored columns of one label, formatted for reading."""
        return ", ".join(f"{column.name} = {row[column.name]}" for column in self.columns)


def check_declaration(
    source: type[EvidenceDeclaration] | EvidenceDeclaration, reserved: Collection[str]
) -> None:
    """Check the declaration of a source.

    Args:
        source: see `EvidenceDeclaration`.
        reserved: column names that a source must not use.

    Raises:
        ConfigError: if a name is invalid or reserved, a column is declared twice or has an unknown
            type, or `rho_column` is not declared as a float64 column.
    """
    place = f"evidence source '{source.name}'"
    if not _NAME.fullmatch(source.name):
        raise ConfigError(f"{place}: the name must be of the form [a-z][a-z0-9_]*")
    seen: set[str] = set()
    for column in source.columns:
        reason = None
        if not _NAME.fullmatch(column.name):
            reason = "the name must be of the form [a-z][a-z0-9_]*"
        elif column.name in seen:
            reason = "declared twice"
        elif column.name in reserved:
            reason = "the name is reserved, choose another one"
        elif column.kind not in KINDS:
            reason = f"unknown type {column.kind!r}, use one of {', '.join(KINDS)}"
        if reason:
            raise ConfigError(f"{place}: column {column.name!r}: {reason}")
        seen.add(column.name)
    if not seen:
        raise ConfigError(f"{place}: declares no columns")
    kinds = {column.name: column.kind for column in source.columns}
    if source.rho_column is not None and kinds.get(source.rho_column) != "float64":
        raise ConfigError(
            f"{place}: rho_column {source.rho_column!r} is not a declared column of type float64"
        )


def check_evidence(
    source: EvidenceDeclaration, evidence: Evidence, count: int
) -> dict[str, list[Any]]:
    """Check the evidence of a frame's labels and return its columns as plain values for storage.

    Args:
        source: see `EvidenceDeclaration`.
        evidence: the evidence that the source returned.
        count: number of labels of the frame.

    Raises:
        DataError: if a column is missing, not declared, or of another length or type, or a value is
            null in a column that is not optional; the message shows source and column.
    """
    columns = [
        *source.columns,
        *(column for column in source.further_columns if column.name in evidence),
    ]
    names = [column.name for column in columns]
    for name in (*names, *evidence):
        if (name in names) != (name in evidence):
            reason = "is missing" if name in names else "is not declared"
            raise DataError(f"evidence source '{source.name}': column {name} {reason}")
    return {
        column.name: _plain(source, column, np.asarray(evidence[column.name]), count)
        for column in columns
    }


def _plain(
    source: EvidenceDeclaration, column: Column, values: np.ndarray, count: int
) -> list[Any]:
    """Return the values of a column as plain Python values; None for NaN."""
    place = f"evidence source '{source.name}': column {column.name}"
    if values.shape != (count,):
        rows = values.shape[0] if values.ndim else 1
        raise DataError(f"{place} has {rows} rows, not {count}")
    plain: list[Any] = values.tolist()
    plain = [None if value is None or value != value else value for value in plain]  # noqa: PLR0124
    for k, value in enumerate(plain):
        reason = _invalid_reason(column, value)
        if not reason and column.name == source.rho_column and value is not None:
            reason = "" if 0 <= value <= 1 else "not in [0, 1]"
        if reason:
            raise DataError(f"{place} of label {k} is {value!r}, {reason}")
    is_integer = column.kind.startswith("int")
    return [int(value) if is_integer and value is not None else value for value in plain]


def _invalid_reason(column: Column, value: Any) -> str:
    """Return why a value is invalid in a column; "" if it is valid."""
    if value is None:
        return "" if column.optional else "but the column is not declared optional"
    if column.kind == "name":
        return "" if isinstance(value, str) else "not text"
    if isinstance(value, str) or not np.isfinite(value):
        return "not a finite number"
    if column.kind == "float64":
        return ""
    in_range = abs(value) < 2 ** (int(column.kind[3:]) - 1)
    return "" if value == int(value) and in_range else f"not a number of {column.kind}"
