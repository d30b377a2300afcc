"""TOML: writing values, and parsing documents that may be hostile.

`tomllib` needs memory proportional to the square of the number of parts in a dotted key (a.b.c has
three). `parse_toml` therefore rejects long keys before it calls `tomllib`.
"""

import json
import re
import tomllib
from typing import Any

# Far above what any setting needs; a key of n parts takes n^2 / 2 references.
MOST_PARTS = 64
MOST_CHARACTERS = 4 << 20

_PART = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![A-Za-z0-9_-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MOST_PARTS}}}")


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a TOML document.

    Raises:
        ValueError: if the text is not TOML, is too long, or has a key of too many parts.
        RecursionError: if values are nested too deeply.
    """
    if len(text) > MOST_CHARACTERS:
        raise ValueError(f"more than {MOST_CHARACTERS} characters")
    text = text.removeprefix("\ufeff")  # byte order mark, which some editors write
    long_key = _LONG_KEY.search(text)
    if long_key:
        line = text.count("\n", 0, long_key.start()) + 1
        raise ValueError(f"a key of more than {MOST_PARTS} parts (at line {line})")
    return tomllib.loads(text)


def toml(value: Any) -> str:
    """Return a value in TOML notation."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        # TOML escapes strings like JSON, and in addition U+007F.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{toml_key(k)} = {toml(v)}' for k, v in value.items())}}}"
    return repr(value)


def toml_key(key: str) -> str:
    """Return a key in TOML notation, quoted only if necessary."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else toml(key)
