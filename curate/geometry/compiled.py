"""Check whether a kernel is in numba's cache; compilation on first use takes seconds."""

from pathlib import Path
from typing import Any


def is_compiled(kernel: Any) -> bool:
    """Return whether numba's cache on disk contains a kernel, judged by file names and times.

    Args:
        kernel: a function decorated with `numba.njit(cache=True)`.
    """
    source = Path(kernel.py_func.__code__.co_filename)
    index = f"{source.stem}.{kernel.py_func.__qualname__}-*.nbi"
    modified = [path.stat().st_mtime for path in Path(kernel.stats.cache_path).glob(index)]
    return max(modified, default=0.0) >= source.stat().st_mtime
