"""Read pickles of numpy arrays and plain containers without executing code from them.

A pickle is a program: it can import any function and call it. This reader looks up every imported
name in a short table of harmless replacements. Any other name stops the reader before anything is
imported. The built-in containers (list, dict, tuple, ...) need no import.
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

# Kinds of numpy types with plain values. "O" is safe: its elements pass the same table.
_KINDS = "biufcSUO"

# Exceptions that the unpickler raises for a damaged pickle.
_DAMAGE_ERRORS = (
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


_STORE_OPCODES = frozenset({"PUT", "BINPUT", "LONG_BINPUT"})
_MAX_DEPTH = 40


class _RejectedError(Exception):
    """The pickle imports a name that is not in the table."""


def read_plain_pickle(path: Path) -> Any:
    """Return the content of a pickle file of arrays, numbers, strings and containers.

    Raises:
        DataError: if the file is missing or damaged, or imports anything else; the message shows
            the imported name.
    """
    try:
        content = Path(path).read_bytes()
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        _check_claimed_sizes(content)
        # Python 2 wrote the bytes of arrays as text; latin-1 keeps every byte.
        value = _PlainUnpickler(io.BytesIO(content), encoding="latin-1").load()
        _check_expanded_size(value, 16 * len(content) + 1000)
    except _RejectedError as rejected:
        raise DataError(
            f"{path}: rejected: the pickle imports {rejected}; only numpy arrays and plain "
            "containers are read. Save tensors and boxes as arrays (boxes.tensor.numpy())"
        ) from None
    except _DAMAGE_ERRORS as error:
        reason = one_line(error, 200) or type(error).__name__
        raise DataError(f"{path}: not a pickle, or a damaged one: {reason}") from None
    return value


def _check_claimed_sizes(content: bytes) -> None:
    """Check the sizes that a pickle claims before the unpickler allocates memory for them.

    pickletools raises ValueError for a length beyond the end of the file. A store opcode with
    object number n makes the unpickler allocate a table of n entries.

    Raises:
        UnpicklingError: if an object number is larger than the file.
    """
    for opcode, argument, _ in pickletools.genops(content):
        if opcode.name in _STORE_OPCODES and int(argument or 0) > len(content):
            raise pickle.UnpicklingError(f"stores object number {argument}")


def _check_expanded_size(value: Any, limit: int) -> None:
    """Check the size of a value with every shared object counted once per reference.

    A few bytes can describe a list of ten references to a list of ten references to a list. Such
    a value fills the memory as soon as it is converted to an array or to text.

    Raises:
        ValueError: if the size exceeds `limit`, or the value is nested too deep or contains itself.
    """
    # Size of each container by id; None while its size is being computed.
    sizes: dict[int, int | None] = {}

    def size(value: Any, depth: int) -> int:
        parts = _parts(value)
        if parts is None:
            return 1 + _leaf_size(value)
        if depth > _MAX_DEPTH or sizes.get(id(value), 0) is None:
            raise ValueError("nested too deep, or contains itself")
        total = sizes.get(id(value))
        if total is None:
            sizes[id(value)] = None
            total = 1 + sum(size(part, depth + 1) for part in parts)
            sizes[id(value)] = total
        if total > limit:
            raise ValueError("refers to the same objects so often that they would fill the memory")
        return total

    size(value, 0)


def _parts(value: Any) -> Iterable[Any] | None:
    """Return the elements of a container; None for other values."""
    if isinstance(value, Mapping):
        return chain(value.keys(), value.values())
    if isinstance(value, list | tuple | set | frozenset):
        return value
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        return list(value.flat)
    return None


def _leaf_size(value: Any) -> int:
    """Return about the number of bytes that a value takes in a pickle."""
    if isinstance(value, np.ndarray | np.generic):
        return value.nbytes
    return len(value) if isinstance(value, str | bytes | bytearray) else 0


class _PlainUnpickler(pickle.Unpickler):
    """Unpickler that looks names up in `_ALLOWED` and imports nothing."""

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        """Return the replacement for an imported name."""
        name = f"{module_name}.{global_name}"
        if name not in _ALLOWED:
            raise _RejectedError(repr(name[:80]).strip("'\""))
        return _ALLOWED[name]


class _Replacement:
    """Callable that replaces an imported name; the pickle cannot change its attributes."""

    __slots__ = ("_function",)
    _function: Callable[..., Any]

    def __init__(self, function: Callable[..., Any]) -> None:
        object.__setattr__(self, "_function", function)

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(name)


class _Dtype:
    """Replacement for numpy.dtype with plain values; reads only the byte order from its state.

    numpy.dtype itself would also read fields and flags from the file without checking them.
    """

    def __init__(self, name: str, _align: object = False, _copy: object = True) -> None:
        self.dtype = np.dtype(str(name))
        if self.dtype.kind not in _KINDS:
            raise _RejectedError(f"numpy.dtype {name}")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        if state[1] in {"<", ">"}:
            self.dtype = self.dtype.newbyteorder(state[1])


class _Array(np.ndarray):
    """Array that gets its type from the `_Dtype` in its pickled state."""

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        version, shape, kind, is_fortran, content = state
        super().__setstate__((version, shape, kind.dtype, is_fortran, content))


def _empty_array(_kind: object, _shape: object, _dtype: object) -> np.ndarray:
    """Return the array that the next instruction of the pickle fills."""
    return _Array((0,), dtype=np.int8)


def _scalar(kind: _Dtype, content: bytes | str) -> Any:
    """Return a numpy number or string."""
    content = content.encode("latin-1") if isinstance(content, str) else content
    return np.frombuffer(content, dtype=kind.dtype, count=1)[0]


def _array_from_buffer(content: Any, kind: _Dtype, shape: Any, order: Any) -> np.ndarray:
    """Return an array from its bytes, as protocol 5 writes it."""
    return np.frombuffer(bytes(content), dtype=kind.dtype).reshape(shape, order=order)


def _array(shape: Any, kind: str, content: Any) -> np.ndarray:
    """Return an array from its bytes, as curate's exports write it."""
    return np.frombuffer(bytes(content), dtype=_Dtype(kind).dtype).reshape(shape)


def _latin1(text: str, _encoding: str) -> bytes:
    """Return the bytes of a text, as protocol 2 writes them."""
    return text.encode("latin-1")


def _bytes_from_content(kind: type, content: bytes = b"") -> Any:
    """Return `bytes` or `bytearray` from content; a number would allocate that many zeros."""
    if not isinstance(content, bytes | bytearray | list | tuple):
        raise TypeError(f"{kind.__name__} of {type(content).__name__}")
    return kind(content)


def _table() -> Mapping[str, Any]:
    """Return the replacement of each allowed name.

    numpy 2.0 moved some functions from numpy.core to numpy._core; both names are allowed.
    """
    moved: dict[str, Callable[..., Any]] = {
        "multiarray._reconstruct": _empty_array,
        "multiarray.scalar": _scalar,
        "numeric._frombuffer": _array_from_buffer,
    }
    containers = (set, frozenset, list, dict, tuple, complex)
    allowed: dict[str, Any] = {
        **{
            f"numpy.{core}.{name}": function
            for core in ("core", "_core")
            for name, function in moved.items()
        },
        # Called by curate's own exports; numpy's pickles give it to _reconstruct, which ignores it.
        "numpy.ndarray": _array,
        "numpy.dtype": _Dtype,
        "_codecs.encode": _latin1,
        "collections.OrderedDict": collections.OrderedDict,
        **{
            f"{module}.{kind.__name__}": kind
            for module in ("builtins", "__builtin__")
            for kind in containers
        },
        **{
            f"{module}.{kind.__name__}": partial(_bytes_from_content, kind)
            for module in ("builtins", "__builtin__")
            for kind in (bytes, bytearray)
        },
    }
    return {
        name: _Replacement(value) if callable(value) else value for name, value in allowed.items()
    }


_ALLOWED = _table()
