"""TOML: values written, and documents read that may be hostile.

tomllib takes memory by the square of a dotted key's length.
"""

import json
import re
import tomllib
from typing import Any

# Far beyond every setting; a key of n parts takes n^2 / 2 references.
MOST_PARTS = 64
MOST_CHARACTERS = 4 << 20

_PART = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![A-Za-z0-9_-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MOST_PARTS}}}")


def parse_toml(text: str) -> dict[str, Any]:
    """Return the document in a text.

    Raises:
        ValueError: if it is no TOML, longer than any settings, or a key of it has too many parts.
        RecursionError: if its values are nested too deeply.
    """
    if len(text) > MOST_CHARACTERS:
        raise ValueError(f"more than {MOST_CHARACTERS} characters")
    text = text.removeprefix("\ufeff")  # which some editors write in front of every file
    found = _LONG_KEY.search(text)
    if found:
        line = text.count("\n", 0, found.start()) + 1
        raise ValueError(f"a key of more than {MOST_PARTS} parts (at line {line})")
    return tomllib.loads(text)


def toml(value: Any) -> str:
    """Return a value in TOML's notation."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        # TOML's strings are escaped as JSON's are, and U+007F besides.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{toml_key(k)} = {toml(v)}' for k, v in value.items())}}}"
    return repr(value)


def toml_key(key: str) -> str:
    """Return a key in TOML's notation, in quotes only where it needs them."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else toml(key)
