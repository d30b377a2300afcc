"""Checks of options against the types and ranges in the signature of the class that gets them."""

import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pydantic import ConfigDict, TypeAdapter, ValidationError

from curate.files.toml_text import toml, toml_key

_LONGEST = 80  # characters of a wrong value that are shown
_CHECKS = ConfigDict(arbitrary_types_allowed=True, allow_inf_nan=False)
# Errors for types that no value of a configuration file has, such as an array or a function.
_NOT_CHECKED = {"callable_type", "needs_python_object"}


def describe_wrong_values(factory: Callable[..., Any], options: Mapping[str, Any]) -> str:
    """Return what is wrong with the values of options, such as `tiles = "x" should be ...`.

    The values are compared with the annotations in the signature. Arguments without one, or with a
    type that is not of a configuration file, are not checked.

    Args:
        factory: the class or function that gets the options.
        options: keyword arguments from a configuration file.

    Returns:
        Every wrong value, on one line; "" if there is none.
    """
    try:
        signature = inspect.signature(factory, eval_str=True)
    except Exception:  # noqa: BLE001 - a user's annotation may refer to anything
        return ""
    types = {
        name: each.annotation
        for name, each in signature.parameters.items()
        if each.annotation is not each.empty
    }
    further = [name for name, each in signature.parameters.items() if each.kind is each.VAR_KEYWORD]
    problems = (
        _describe(name, value, types[key])
        for name, value in options.items()
        if (key := name if name in signature.parameters else "".join(further)) in types
    )
    return "; ".join(filter(None, problems))


def _describe(name: str, value: Any, annotation: Any) -> str:
    """Return what is wrong with a value; "" if nothing is, or the type is not checked.

    The value is read as JSON, in which a list may be a tuple and a string a path. Nothing else is
    converted: neither "1" nor true is a number.
    """
    try:
        adapter: TypeAdapter[Any] = TypeAdapter(annotation, config=_CHECKS)
    except Exception:  # noqa: BLE001 - a user's annotation may be anything
        return ""
    try:
        adapter.validate_json(json.dumps(value, default=str), strict=True)
    except ValidationError as error:
        found = [(_keys(each["loc"], value), each) for each in error.errors(include_url=False)]
    else:
        return ""
    if any(each["type"] in _NOT_CHECKED for _, each in found):
        return ""
    # Of the members of a union, the one that fits best has the innermost error.
    innermost = max((keys for keys, _ in found), key=len)
    expected = dict.fromkeys(_expected(each["msg"]) for keys, each in found if keys == innermost)
    place = ".".join(map(toml_key, (name, *map(str, innermost))))
    for key in innermost:
        value = value[key]
    return f"{place} = {_shown(value)} should {' or '.join(expected)}"


def _keys(location: Sequence[int | str], value: Any) -> tuple[int | str, ...]:
    """Return the keys in the location of an error, which also has the names of union members."""
    keys: list[int | str] = []
    for key in location:
        try:
            value = value[key]
        except (LookupError, TypeError):
            continue
        keys.append(key)
    return tuple(keys)


def _expected(message: str) -> str:
    """Return what pydantic expects, in the words of TOML: "Input should be an object"."""
    words = message.partition(" should ")[2] or "have more entries"  # "Field required", in a tuple
    return words.replace("an object", "a table").replace("a valid array", "a list")


def _shown(value: Any) -> str:
    text = " ".join(toml(value).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
