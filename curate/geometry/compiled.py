"""Whether a kernel must still be compiled, which takes seconds the first time it is used."""

from pathlib import Path
from typing import Any


def is_compiled(kernel: Any) -> bool:
    """Return whether numba's cache on disk holds a kernel, as far as names and times of files tell.

    Args:
        kernel: a function under `numba.njit(cache=True)`.
    """
    source = Path(kernel.py_func.__code__.co_filename)
    index = f"{source.stem}.{kernel.py_func.__qualname__}-*.nbi"
    written = [path.stat().st_mtime for path in Path(kernel.stats.cache_path).glob(index)]
    return max(written, default=0.0) >= source.stat().st_mtime
