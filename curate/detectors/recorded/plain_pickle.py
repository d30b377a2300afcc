"""Pickles of numpy arrays and plain containers, read without running anything that they name.

A pickle is a program: it may name any function and call it. Here every name is looked up in a short
table of harmless stand-ins, and any other name ends the reading before it is imported. The built-in
containers need no names.
"""

import collections
import io
import pickle
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from curate.errors import DataError

# Kinds of numpy's types that hold plain values; objects come only as elements that are plain.
_KINDS = "biufcSUO"

# What a damaged pickle makes the interpreter of pickles raise.
_DAMAGES = (
    pickle.UnpicklingError,
    AttributeError,
    EOFError,
    IndexError,
    KeyError,
    MemoryError,
    OverflowError,
    RecursionError,
    TypeError,
    ValueError,
)


class _RefusedError(Exception):
    """The pickle names something that is not in the table."""


def read_plain_pickle(path: Path) -> Any:
    """What a pickle file of arrays, numbers, strings and containers holds.

    Raises:
        DataError: the file is missing or damaged, or names anything else; the name is given.
    """
    try:
        content = Path(path).read_bytes()
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        return _PlainUnpickler(io.BytesIO(content)).load()
    except _RefusedError as refused:
        raise DataError(
            f"{path}: refused, the pickle names {refused}; only numpy arrays and plain containers "
            "are read: save tensors and boxes as arrays (boxes.tensor.numpy())"
        ) from None
    except _DAMAGES as error:
        words = " ".join(str(error).split()) or type(error).__name__
        raise DataError(f"{path}: no pickle, or a damaged one: {words}") from None


class _PlainUnpickler(pickle.Unpickler):
    """Looks names up in `_ADMITTED` and imports nothing."""

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        """The stand-in for a name."""
        name = f"{module_name}.{global_name}"
        if name not in _ADMITTED:
            raise _RefusedError(name)
        return _ADMITTED[name]


class _Type:
    """Stands in for a numpy.dtype of plain values; of its later state only the byte order counts.

    numpy's own would also take fields and flags from the file, and trust them.
    """

    def __init__(self, name: str, _align: object = False, _copy: object = True) -> None:
        self.made = np.dtype(str(name))
        if self.made.kind not in _KINDS:
            raise _RefusedError(f"numpy.dtype {name}")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        if state[1] in {"<", ">"}:
            self.made = self.made.newbyteorder(state[1])


class _Array(np.ndarray):
    """An array whose later state names its type by a `_Type`."""

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        version, shape, kind, is_fortran, content = state
        super().__setstate__((version, shape, kind.made, is_fortran, content))


def _empty_array(_kind: object, _shape: object, _dtype: object) -> np.ndarray:
    """The array that the pickle's next instruction fills."""
    return _Array((0,), dtype=np.int8)


def _scalar(kind: _Type, content: bytes) -> Any:
    """A number or string of numpy's."""
    return np.frombuffer(content, dtype=kind.made, count=1)[0]


def _array_of_bytes(content: Any, kind: _Type, shape: Any, order: Any) -> np.ndarray:
    """An array from its bytes, as protocol 5 writes it."""
    return np.frombuffer(bytes(content), dtype=kind.made).reshape(shape, order=order)


def _latin1(text: str, _encoding: str) -> bytes:
    """Bytes, as protocol 2 writes them."""
    return text.encode("latin-1")


def _table() -> Mapping[str, Any]:
    """Names and what stands in for them; numpy's moved from numpy.core to numpy._core in 2.0."""
    moved: dict[str, Callable[..., Any]] = {
        "multiarray._reconstruct": _empty_array,
        "multiarray.scalar": _scalar,
        "numeric._frombuffer": _array_of_bytes,
    }
    containers = (set, frozenset, list, dict, tuple, bytes, bytearray, complex)
    return {
        **{f"numpy.{core}.{name}": of for core in ("core", "_core") for name, of in moved.items()},
        "numpy.ndarray": "numpy.ndarray",  # only ever named, as the first of `_empty_array`
        "numpy.dtype": _Type,
        "_codecs.encode": _latin1,
        "collections.OrderedDict": collections.OrderedDict,
        **{
            f"{home}.{kind.__name__}": kind
            for home in ("builtins", "__builtin__")
            for kind in containers
        },
    }


_ADMITTED = _table()
