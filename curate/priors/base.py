"""Evidence sources: what they declare, and what they measure of the labels of a frame or sequence.

A source declares its columns once, with type, unit and meaning. Its table, the columns of
`weighted_labels` and of every export, and what is explained and reported follow from that.
"""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np

from curate.detections import Detections
from curate.errors import ConfigError, DataError
from curate.frames import Frame

KINDS = ("int32", "int64", "float64", "name")
_NAME = re.compile(r"[a-z][a-z0-9_]*")


@dataclass(frozen=True)
class Column:
    """One column of evidence, or of the weighted labels.

    Attributes:
        name: of the column.
        kind: type of its values, one of `KINDS`.
        unit: "m", "rad", "px", "1" for a number without unit, "" for what is not a quantity.
        meaning: in a few words, with the symbol and equation of the paper.
        optional: whether it is null where there is no evidence.
    """

    name: str
    kind: str
    unit: str
    meaning: str
    optional: bool = False


Measured = Mapping[str, np.ndarray]
"""(n,) arrays of n labels, by the names of `EvidenceSource.measured_columns`."""
Evidence = Mapping[str, np.ndarray]
"""(n,) arrays of n labels, by the names of a source's columns."""


class Declared(Protocol):
    """What every source of evidence declares."""

    name: ClassVar[str]
    """Its evidence is stored under this name."""
    columns: ClassVar[tuple[Column, ...]]
    """All that it stores of a label."""
    rho_column: ClassVar[str | None] = None
    """The column with a prior's trust rho in [0, 1]; rho_det is the product over the priors."""


class EvidenceSource(Declared, Protocol):
    """Looks at one frame: a second opinion on each of its labels. A class inherits from it.

    It works in two steps: measuring looks at what the sensors saw, which may be slow, rating is
    arithmetic on what was measured. A changed formula needs no new measurement.

    The pipeline gives the constructor what it names: `segmenter` (None where nothing is to be
    measured), `thresholds` (points per category, learned from X_l), and the user's options.
    """

    measured_columns: ClassVar[tuple[str, ...]]

    @property
    def needs_points(self) -> bool:
        """Return whether `measure` reads `frame.points`."""
        return True

    @property
    def needs_image(self) -> bool:
        """Return whether `measure` reads `frame.image`."""
        return False

    def measure(self, frame: Frame, detections: Detections) -> Measured:
        """Return what the frame shows of each of its detections, in their order."""
        ...

    def rate(self, detections: Detections, measured: Measured) -> Evidence:
        """Return the evidence that follows from what was measured: all columns."""
        ...

    def score(self, frame: Frame, detections: Detections) -> Evidence:
        """Return the evidence of each of the frame's detections: measured, then rated."""
        return self.rate(detections, self.measure(frame, detections))

    def describe(self, row: Mapping[str, Any]) -> str:
        """Return a line that explains the stored columns of one label, formatted for reading."""
        return ", ".join(f"{column.name} = {row[column.name]}" for column in self.columns)


@dataclass(frozen=True)
class SequenceFrame:
    """A frame of a sequence.

    Attributes:
        frame_id: name of the frame.
        detections: the labels of the frame, by k.
        read: reads the frame with its points, where the source needs more than the labels.
    """

    frame_id: str
    detections: Detections
    read: Callable[[], Frame]


class SequenceSource(Declared, Protocol):
    """Looks at all frames of a sequence together, such as a tracker. A class inherits from it."""

    def score_sequence(self, frames: Sequence[SequenceFrame]) -> Sequence[Evidence]:
        """Return the evidence of each frame's labels, in the order of the frames."""
        ...

    def describe(self, row: Mapping[str, Any]) -> str:
        """Return a line that explains the stored columns of one label, formatted for reading."""
        return ", ".join(f"{column.name} = {row[column.name]}" for column in self.columns)


def check_declaration(source: type[Declared] | Declared, reserved: Collection[str]) -> None:
    """Check what a source declares.

    Args:
        source: see `Declared`.
        reserved: names of columns that are not to be taken.

    Raises:
        ConfigError: if a name is invalid or reserved, a column is declared twice or of an unknown
            type, or the column of the trust is not declared as a number.
    """
    known = f"evidence source '{source.name}'"
    if not _NAME.fullmatch(source.name):
        raise ConfigError(f"{known}: the name must be of the form [a-z][a-z0-9_]*")
    seen: set[str] = set()
    for column in source.columns:
        fault = None
        if not _NAME.fullmatch(column.name):
            fault = "the name must be of the form [a-z][a-z0-9_]*"
        elif column.name in seen:
            fault = "declared twice"
        elif column.name in reserved:
            fault = "the name is reserved, choose another one"
        elif column.kind not in KINDS:
            fault = f"unknown type {column.kind!r}, use one of {', '.join(KINDS)}"
        if fault:
            raise ConfigError(f"{known}: column {column.name!r}: {fault}")
        seen.add(column.name)
    if not seen:
        raise ConfigError(f"{known}: declares no columns")
    kinds = {column.name: column.kind for column in source.columns}
    if source.rho_column is not None and kinds.get(source.rho_column) != "float64":
        raise ConfigError(
            f"{known}: rho_column {source.rho_column!r} is not a declared column of type float64"
        )


def check_evidence(source: Declared, evidence: Evidence, count: int) -> dict[str, list[Any]]:
    """Return the columns of a frame's labels as plain values, as they are stored.

    Args:
        source: see `Declared`.
        evidence: what it returned.
        count: number of labels of the frame.

    Raises:
        DataError: if a column is missing, not declared, too short, of another type, or unknown
            where that was not declared; the message names the source and the column.
    """
    names = [column.name for column in source.columns]
    for name in (*names, *evidence):
        if (name in names) != (name in evidence):
            fault = "is missing" if name in names else "is not declared"
            raise DataError(f"evidence source '{source.name}': column {name} {fault}")
    return {
        column.name: _plain(source, column, np.asarray(evidence[column.name]), count)
        for column in source.columns
    }


def _plain(source: Declared, column: Column, values: np.ndarray, count: int) -> list[Any]:
    """Return the values of a column; None for what is unknown."""
    known = f"evidence source '{source.name}': column {column.name}"
    if values.shape != (count,):
        raise DataError(f"{known} has {values.shape[0] if values.ndim else 1} rows, not {count}")
    plain: list[Any] = values.tolist()
    plain = [None if value is None or value != value else value for value in plain]  # noqa: PLR0124
    for k, value in enumerate(plain):
        fault = _fault(column, value)
        if not fault and column.name == source.rho_column and value is not None:
            fault = "" if 0 <= value <= 1 else "not in [0, 1]"
        if fault:
            raise DataError(f"{known} of label {k} is {value!r}, {fault}")
    whole = column.kind.startswith("int")
    return [int(value) if whole and value is not None else value for value in plain]


def _fault(column: Column, value: Any) -> str:
    """What is wrong with a value of a column; "" where nothing is."""
    if value is None:
        return "" if column.optional else "but the column is not declared optional"
    if column.kind == "name":
        return "" if isinstance(value, str) else "not text"
    if isinstance(value, str) or not np.isfinite(value):
        return "not a finite number"
    if column.kind == "float64":
        return ""
    inside = abs(value) < 2 ** (int(column.kind[3:]) - 1)
    return "" if value == int(value) and inside else f"not a number of {column.kind}"
