"""Write JSON documents, and read numbers from JSON of other tools."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from curate.errors import DataError


def write_json(path: Path, document: Any) -> None:
    """Write an indented JSON document."""
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def numbers(value: Any, names: Sequence[str], place: str) -> list[float]:
    """Return the numbers of a mapping by name, or of a list in this order.

    Raises:
        DataError: if one is missing or not a number.
    """
    if isinstance(value, Mapping):
        value = [value.get(name) for name in names]
    if (
        not isinstance(value, list)
        or len(value) != len(names)
        or any(isinstance(each, bool) or not isinstance(each, int | float) for each in value)
    ):
        raise DataError(f"{place}: expected numbers for {', '.join(names)}, got {value!r}")
    return [float(each) for each in value]
