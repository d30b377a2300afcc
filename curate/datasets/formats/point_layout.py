"""The layout of point files: how many columns they have, and which of them are read.

A file with a header (PCD, PLY, a structured .npy) names its columns itself. For files without a
header, the layout is declared; KITTI's x, y, z, intensity is the default.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from curate.errors import ConfigError, DataError
from curate.spelling import did_you_mean

DEFAULT_NAMES = ("x", "y", "z", "intensity")
_INTENSITY_NAMES = frozenset(
    {"intensity", "intensities", "reflectivity", "reflectance", "remission", "i"}
)
# CloudCompare writes this in front of the names of all columns but x, y, z and the colours.
_PREFIX = "scalar_"
_MAX_COLUMNS = 64


@dataclass(frozen=True)
class PointLayout:
    """The declared layout of the point files of a data set; None stands for its default.

    Attributes:
        columns: number of columns of files without a header. The default is KITTI's 4, and a file
            that looks like another number of columns is rejected.
        column_names: names of these columns, in any order; x, y and z are needed.
        intensity_field: name of the column of the intensity; by default, the only column with one
            of the usual names, such as Intensity or reflectivity; zeros if there is none.
        intensity_scale: the value of full intensity, e.g. 255; 1 by default.

    Raises:
        ConfigError: if a value is invalid, or two of them contradict each other.
    """

    columns: int | None = None
    column_names: tuple[str, ...] | None = None
    intensity_field: str | None = None
    intensity_scale: float | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        if self.columns is not None and not 3 <= self.columns <= _MAX_COLUMNS:
            raise ConfigError(f"columns = {self.columns}: must be 3 to {_MAX_COLUMNS}")
        if self.intensity_scale is not None and not 0 < self.intensity_scale < float("inf"):
            raise ConfigError(f"intensity_scale = {self.intensity_scale}: must be above 0")
        if self.column_names is None:
            return
        names = self.column_names
        if self.columns is not None and self.columns != len(names):
            raise ConfigError(
                f"column_names has {len(names)} names, but columns is {self.columns}; "
                "remove one of them"
            )
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ConfigError(f"column_names contains '{repeated[0]}' twice")
        try:
            self.indices("column_names", names)
        except DataError as error:
            raise ConfigError(str(error)) from None

    @property
    def is_declared(self) -> bool:
        """Whether the number of columns is declared."""
        return self.columns is not None or self.column_names is not None

    @property
    def full_intensity(self) -> float:
        """The value of full intensity."""
        return 1.0 if self.intensity_scale is None else self.intensity_scale

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the columns of a file without a header; those after the fourth are ""."""
        if self.column_names is not None:
            return self.column_names
        count = len(DEFAULT_NAMES) if self.columns is None else self.columns
        return (*DEFAULT_NAMES, *[""] * count)[:count]

    def with_defaults(self, columns: int, intensity_scale: float) -> Self:
        """Return the layout with the defaults of a data set's format in place of None."""
        return replace(
            self,
            columns=len(self.names) if self.is_declared else columns,
            intensity_scale=(
                intensity_scale if self.intensity_scale is None else self.intensity_scale
            ),
        )

    def indices(self, source: Path | str, names: Sequence[str]) -> list[int]:
        """Return the positions of x, y, z and, if there is one, of the intensity.

        Upper and lower case are equal, and CloudCompare's prefix `scalar_` is ignored.

        Args:
            source: the file, for error messages.
            names: the names of all columns; "" for a column that cannot be chosen.

        Raises:
            DataError: if x, y or z is missing, or several columns may be the intensity.
        """
        keys = [_key(name) for name in names]
        chosen = []
        for axis in "xyz":
            found = [k for k, key in enumerate(keys) if key == axis]
            if len(found) != 1:
                problem = "no column" if not found else "several columns"
                raise DataError(f"{source}: {problem} {axis} among {_listed(names)}")
            chosen += found
        return chosen + self._intensity(source, names, keys)

    def _intensity(self, source: Path | str, names: Sequence[str], keys: list[str]) -> list[int]:
        """Return the position of the intensity in a list; empty if there is none."""
        if self.intensity_field is not None:
            wanted = self.intensity_field
            found = [k for k, name in enumerate(names) if name == wanted]
            found = found or [k for k, key in enumerate(keys) if key == _key(wanted)]
            if len(found) != 1:
                raise DataError(
                    f"{source}: no column '{wanted}' (dataset.intensity_field) among "
                    f"{_listed(names)}{did_you_mean(wanted, filter(None, names))}"
                )
            return found
        found = [k for k, key in enumerate(keys) if key in _INTENSITY_NAMES]
        if len(found) > 1:
            candidates = " and ".join(names[k] for k in found)
            raise DataError(
                f"{source}: {candidates} may all be the intensity; set dataset.intensity_field to "
                "one of them"
            )
        return found


UNDECLARED = PointLayout()
"""The layout of a data set of which nothing is declared."""


def _key(name: str) -> str:
    return name.casefold().removeprefix(_PREFIX)


def _listed(names: Sequence[str]) -> str:
    """Return the names for a message; a header may contain very many."""
    known = [name[:40] for name in names if name]
    return ", ".join(known[:20]) + (", ..." if len(known) > 20 else "") or "no names"
