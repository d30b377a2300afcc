"""Where an export may be written: nothing is replaced but a former export."""

import json
from collections.abc import Callable
from pathlib import Path

from curate.errors import ConfigError


def check_place(path: Path, is_former: Callable[[Path], bool]) -> None:
    """Raise ConfigError where an export would replace something that is not a former export.

    Args:
        path: of the export to come.
        is_former: whether what is there is a former export of the same format; an error of reading
            it says no.
    """
    if path.is_symlink():
        raise ConfigError(
            f"{path}: is a link, in whose place the export would come; name what it leads to, or "
            "remove the link"
        )
    if not path.exists():
        return
    try:
        known = is_former(path)
    except (OSError, ValueError, TypeError, KeyError):
        known = False
    if not known:
        raise ConfigError(
            f"{path}: is there and is no former export; name another "
            f"{'folder' if path.is_dir() else 'file'}"
        )


def says(section: str, words: str) -> Callable[[Path], bool]:
    """Return a check whether a JSON file has these words as the description in a section."""
    return lambda path: bool(json.loads(path.read_bytes())[section]["description"] == words)
