"""Check where an export may be written: it may only replace a previous export."""

import json
from collections.abc import Callable
from pathlib import Path

from curate.errors import ConfigError


def check_place(path: Path, is_export: Callable[[Path], bool]) -> None:
    """Check that an export replaces nothing but a previous export.

    Args:
        path: path of the new export.
        is_export: returns whether the existing file or folder is an export of the same format; an
            error while reading it means no.

    Raises:
        ConfigError: if something else is at the path, or the path is a symbolic link.
    """
    if path.is_symlink():
        raise ConfigError(
            f"{path}: is a symbolic link, which the export would replace; use the path of its "
            "target, or remove the link"
        )
    if not path.exists():
        return
    try:
        replaceable = is_export(path)
    except (OSError, ValueError, TypeError, KeyError):
        replaceable = False
    if not replaceable:
        raise ConfigError(
            f"{path}: exists and is not a previous export; choose another "
            f"{'folder' if path.is_dir() else 'file'}"
        )


def has_description(section: str, description: str) -> Callable[[Path], bool]:
    """Return a function that checks the `description` in a section of a JSON file."""
    return lambda path: bool(json.loads(path.read_bytes())[section]["description"] == description)
