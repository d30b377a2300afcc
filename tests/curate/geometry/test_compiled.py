"""The check whether kernels are compiled already."""

import importlib.util
import os

import numpy as np

from curate.geometry.compiled import is_compiled

SOURCE = """
from numba import njit

@njit(cache=True)
def doubled(numbers):
    return numbers * 2
"""


def loaded(path):
    """Return the kernel in a file, as a new process would see it."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.doubled


def test_a_kernel_is_compiled_after_its_first_call(tmp_path):
    """And not any more once its source has changed."""
    path = tmp_path / "kernel.py"
    path.write_text(SOURCE)
    os.utime(path, (1_000_000_000, 1_000_000_000))
    kernel = loaded(path)
    assert not is_compiled(kernel)
    kernel(np.ones(2))
    assert is_compiled(kernel)
    assert is_compiled(loaded(path))
    path.write_text(SOURCE)
    os.utime(path, (4_000_000_000, 4_000_000_000))
    assert not is_compiled(loaded(path))
