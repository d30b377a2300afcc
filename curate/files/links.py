"""A file that appears in another folder without a copy of its content, where that is possible."""

import contextlib
import os
import shutil
from pathlib import Path

from curate.files.atomic import atomic_path


def link_file(source: Path, target: Path) -> None:
    """Make a file appear at another path: as a hard link, as a symbolic link, or as a copy.

    A target of the same size stays, any other one is replaced. Missing parent folders are created.
    """
    if is_linked(source, target):
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    original = os.path.realpath(source)
    for make in (os.link, os.symlink):
        # FileExistsError: another process was faster. Other errors: file systems without links,
        # or two of them.
        with contextlib.suppress(OSError):
            make(original, target)
        if target.exists():
            return
    with atomic_path(target) as partial:
        shutil.copyfile(original, partial)


def is_linked(source: Path, target: Path) -> bool:
    """Return whether a file appears at another path, as far as its size shows."""
    try:
        return target.stat().st_size == source.stat().st_size
    except OSError:
        return False
