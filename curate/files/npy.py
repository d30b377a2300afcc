"""Arrays in .npy files, without pickles."""

import tokenize
import warnings
from pathlib import Path

import numpy as np

from curate.errors import DataError, one_line

# The errors that numpy raises for a damaged header.
_ERRORS = (
    EOFError,
    MemoryError,
    OSError,
    OverflowError,
    RecursionError,
    SyntaxError,
    TypeError,
    ValueError,
    tokenize.TokenError,
)


def map_npy(path: Path, kind: str = "array") -> np.ndarray:
    """Return the array of a file as a memory map.

    A header that claims more than the file contains allocates no memory. Pickles and archives are
    rejected.

    Args:
        path: the file.
        kind: what the file is, for messages.

    Raises:
        DataError: if the file is missing or damaged.
    """
    try:
        with warnings.catch_warnings():
            # Python warns about odd literals in the header, numpy about files of Python 2.
            warnings.simplefilter("ignore")
            array: np.ndarray = np.lib.format.open_memmap(path, mode="r")
    except FileNotFoundError:
        raise DataError(f"{path}: no such {kind} file") from None
    except _ERRORS as error:
        raise DataError(f"{path}: not a readable .npy array: {one_line(error, 200)}") from None
    return array
