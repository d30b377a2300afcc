"""Check array shapes while the tests run: `make shapes`, jaxtyping's import hook with beartype.

    pytest --jaxtyping-packages=curate,support.shapes.check

Two things need help. The hook wraps every function below its other decorators, and numba cannot
compile the wrapper: kernels are skipped, and only their callers are checked. Beartype checks a
method outside of its class and cannot resolve `Self`: of the types of a function, only arrays and
tensors are checked; mypy checks all others.
"""

import ast
from collections.abc import Callable
from typing import Any, get_args

from beartype import beartype
from jaxtyping import AbstractArray, _import_hook

_skipped = _import_hook._is_no_type_check  # noqa: SLF001 - the hook has no public way to skip


def _is_skipped(decorator: ast.AST) -> bool:
    name = decorator.func if isinstance(decorator, ast.Call) else decorator
    return _skipped(decorator) or (isinstance(name, ast.Name) and name.id == "njit")


_import_hook._is_no_type_check = _is_skipped  # noqa: SLF001


def check(function: Callable) -> Callable:
    """Return a function that checks the shapes and dtypes of its arrays."""
    function.__annotations__ = {
        name: hint if _has_shape(hint) else Any for name, hint in function.__annotations__.items()
    }
    return beartype(function)


def _has_shape(hint: Any) -> bool:
    """Return whether a type is an array with a shape, or contains one."""
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return True
    return any(map(_has_shape, get_args(hint)))
