"""The reader of JSON files of other programs.

Python's own reader also accepts NaN and Infinity, which are not JSON, and keeps the last of two
equal keys. Both are rejected here.
"""

import json
import re
from pathlib import Path
from typing import Any

from curate.errors import DataError, one_line
from curate.files.text import decode_text, read_text

# Strings, which may contain anything, are matched first; a constant has group 1.
_CONSTANT = re.compile(r'"(?:[^"\\]|\\.)*+"|(-?Infinity|NaN)', re.DOTALL)


def read_json(path: Path, kind: str = "JSON") -> Any:
    """Return the content of a JSON file.

    Args:
        path: the file.
        kind: what the file is, for messages.

    Raises:
        DataError: if it is missing or not JSON, or contains NaN, Infinity or a key twice.
    """
    return parse_json(read_text(path, kind), path)


def parse_json(content: str | bytes, place: object) -> Any:
    """Return the content of a JSON document.

    Args:
        content: the document; bytes are UTF-8.
        place: the file, for messages.

    Raises:
        DataError: if it is not JSON, or contains NaN, Infinity or a key twice.
    """
    text = decode_text(content, place) if isinstance(content, bytes) else content
    try:
        return _DECODER.decode(text)
    except _ConstantError as error:
        match = next(found for found in _CONSTANT.finditer(text) if found[1])
        line, column = text.count("\n", 0, match.start()) + 1, _column(text, match.start())
        raise DataError(
            f"{place}:{line}: {error} at column {column} is not JSON; write a number, or null for "
            "a value that is not known"
        ) from None
    except json.JSONDecodeError as error:
        if error.msg == "Extra data":
            raise DataError(
                f"{place}:{error.lineno}: cannot be read as JSON: a second document; put the "
                "documents of JSON Lines into one list"
            ) from None
        raise DataError(
            f"{place}:{error.lineno}: cannot be read as JSON: {error.msg} at column {error.colno}"
        ) from None
    except (RecursionError, ValueError) as error:
        raise DataError(f"{place}: cannot be read as JSON: {one_line(error, 200)}") from None


class _ConstantError(Exception):
    """The document contains NaN or Infinity."""


def _reject_constant(name: str) -> None:
    raise _ConstantError(name)


def _without_repeated_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        repeated = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {repeated[:80]!r} occurs twice in one object")
    return found


def _column(text: str, position: int) -> int:
    return position - text.rfind("\n", 0, position)


_DECODER = json.JSONDecoder(
    parse_constant=_reject_constant, object_pairs_hook=_without_repeated_keys
)
