"""Pickles of numpy arrays and plain containers, read without running anything that they name.

A pickle is a program: it may name any function and call it. Here every name is looked up in a short
table of harmless stand-ins, and any other name ends the reading before it is imported. The built-in
containers need no names.
"""

import collections
import io
import pickle
import pickletools
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from curate.errors import DataError, one_line

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


_STORES = frozenset({"PUT", "BINPUT", "LONG_BINPUT"})
_DEEPEST = 40


class _RejectedError(Exception):
    """The pickle names something that is not in the table."""


def read_plain_pickle(path: Path) -> Any:
    """What a pickle file of arrays, numbers, strings and containers holds.

    Raises:
        DataError: if the file is missing or damaged, or names anything else; the name is given.
    """
    try:
        content = Path(path).read_bytes()
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        _check_claimed_sizes(content)
        held = _PlainUnpickler(io.BytesIO(content)).load()
        _unfolded(held, 16 * len(content) + 1000)
    except _RejectedError as refused:
        raise DataError(
            f"{path}: refused, the pickle names {refused}; only numpy arrays and plain containers "
            "are read: save tensors and boxes as arrays (boxes.tensor.numpy())"
        ) from None
    except _DAMAGES as error:
        words = one_line(error, 200) or type(error).__name__
        raise DataError(f"{path}: no pickle, or a damaged one: {words}") from None
    return held


def _check_claimed_sizes(content: bytes) -> None:
    """UnpicklingError for what the interpreter of pickles would take at its word, at any cost.

    A length beyond the end of the file is a ValueError of pickletools; a number in the table of
    known objects makes the interpreter lay out that table up to there.
    """
    for opcode, argument, _ in pickletools.genops(content):
        if opcode.name in _STORES and int(argument or 0) > len(content):
            raise pickle.UnpicklingError(f"stores object number {argument}")


def _unfolded(held: Any, most: int) -> int:
    """How much a value is where everything that it names twice is counted twice, up to `most`.

    A few bytes can name a list of lists of lists, each ten times, which fills any memory as soon as
    someone makes an array or a text of it.

    Raises:
        ValueError: if it is more, nested too deep, or holds itself.
    """
    known: dict[int, int | None] = {}

    def size(value: Any, depth: int) -> int:
        parts = _parts(value)
        if parts is None:
            return 1 + _own_size(value)
        if depth > _DEEPEST or known.get(id(value), 0) is None:
            raise ValueError("nested too deep, or in itself")
        found = known.get(id(value))
        if found is None:
            known[id(value)] = None
            found = 1 + sum(size(part, depth + 1) for part in parts)
            known[id(value)] = found
        if found > most:
            raise ValueError("names the same things so often that they would fill the memory")
        return found

    return size(held, 0)


def _parts(value: Any) -> Iterable[Any] | None:
    """What a container holds; None for what is none."""
    if isinstance(value, Mapping):
        return chain(value.keys(), value.values())
    if isinstance(value, list | tuple | set | frozenset):
        return value
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        return list(value.flat)
    return None


def _own_size(value: Any) -> int:
    """Of a leaf, in about the bytes that it takes in a pickle."""
    if isinstance(value, np.ndarray | np.generic):
        return value.nbytes
    return len(value) if isinstance(value, str | bytes | bytearray) else 0


class _PlainUnpickler(pickle.Unpickler):
    """Looks names up in `_ADMITTED` and imports nothing."""

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        """Return the stand-in for a name."""
        name = f"{module_name}.{global_name}"
        if name not in _ADMITTED:
            raise _RejectedError(repr(name[:80]).strip("'\""))
        return _ADMITTED[name]


class _StandIn:
    """Calls a function in the place of what a pickle names, and takes no state from the pickle."""

    __slots__ = ("_function",)
    _function: Callable[..., Any]

    def __init__(self, function: Callable[..., Any]) -> None:
        object.__setattr__(self, "_function", function)

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(name)


class _Type:
    """Stands in for a numpy.dtype of plain values; of its later state only the byte order counts.

    numpy's own would also take fields and flags from the file, and trust them.
    """

    def __init__(self, name: str, _align: object = False, _copy: object = True) -> None:
        self.made = np.dtype(str(name))
        if self.made.kind not in _KINDS:
            raise _RejectedError(f"numpy.dtype {name}")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        if state[1] in {"<", ">"}:
            self.made = self.made.newbyteorder(state[1])


class _Array(np.ndarray):
    """An array whose later state names its type by a `_Type`."""

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        version, shape, kind, is_fortran, content = state
        super().__setstate__((version, shape, kind.made, is_fortran, content))


def _empty_array(_kind: object, _shape: object, _dtype: object) -> np.ndarray:
    """Return the array that the pickle's next instruction fills."""
    return _Array((0,), dtype=np.int8)


def _scalar(kind: _Type, content: bytes) -> Any:
    """Return a number or string of numpy's."""
    return np.frombuffer(content, dtype=kind.made, count=1)[0]


def _array_of_bytes(content: Any, kind: _Type, shape: Any, order: Any) -> np.ndarray:
    """Return an array from its bytes, as protocol 5 writes it."""
    return np.frombuffer(bytes(content), dtype=kind.made).reshape(shape, order=order)


def _latin1(text: str, _encoding: str) -> bytes:
    """Bytes, as protocol 2 writes them."""
    return text.encode("latin-1")


def _of_bytes(kind: type, content: bytes = b"") -> Any:
    """Either kind of bytes, of bytes; of a number they would be that many zeros."""
    if not isinstance(content, bytes | bytearray | list | tuple):
        raise TypeError(f"{kind.__name__} of {type(content).__name__}")
    return kind(content)


def _table() -> Mapping[str, Any]:
    """Name and what stands in for them; numpy's moved from numpy.core to numpy._core in 2.0."""
    moved: dict[str, Callable[..., Any]] = {
        "multiarray._reconstruct": _empty_array,
        "multiarray.scalar": _scalar,
        "numeric._frombuffer": _array_of_bytes,
    }
    containers = (set, frozenset, list, dict, tuple, complex)
    named: dict[str, Any] = {
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
        **{
            f"{home}.{kind.__name__}": partial(_of_bytes, kind)
            for home in ("builtins", "__builtin__")
            for kind in (bytes, bytearray)
        },
    }
    return {name: _StandIn(made) if callable(made) else made for name, made in named.items()}


_ADMITTED = _table()
