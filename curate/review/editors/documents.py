"""Numbers of foreign JSON documents, and documents of our own."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from curate.errors import DataError


def write_json(path: Path, document: Any) -> None:
    """Writes a document that people may read."""
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def numbers(value: Any, names: Sequence[str], place: str) -> list[float]:
    """The numbers of a mapping by name, or of a list in their order.

    Raises:
        DataError: one is missing or no number.
    """
    if isinstance(value, Mapping):
        value = [value.get(name) for name in names]
    if (
        not isinstance(value, list)
        or len(value) != len(names)
        or any(isinstance(each, bool) or not isinstance(each, int | float) for each in value)
    ):
        raise DataError(f"{place}: needs numbers for {', '.join(names)}, not {value!r}")
    return [float(each) for each in value]
