"""Descriptions of what configuration fields accept, for pages, comments and error messages."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from curate.files.toml_text import toml
from pipelines.workspace.names import KnownClassSet, KnownName, KnownProvider

_TYPES = {bool: "true or false", int: "whole number", float: "number", str: "string", Path: "path"}
_NAMED = KnownName | KnownClassSet | KnownProvider  # they know the valid names
_COUNTS = {2: "two", 3: "three"}


@dataclass(frozen=True)
class Accepted:
    """The values that a setting accepts.

    Attributes:
        type: name of the type, such as "whole number".
        range: limits of a number, such as "at least 1"; "" without limits.
        choices: the valid names; () if any value of the type is valid.
        open: whether `module:Class` is valid, too.
        words: words that are valid besides the values of the type, such as "auto".
    """

    type: str
    range: str = ""
    choices: tuple[str, ...] = ()
    open: bool = False
    words: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return a phrase, such as "a number from 0 to 1" or "a whole number, at least 1"."""
        if self.choices:
            more = " or module:Class" if self.open else ""
            kind = "a list of " if self.type.startswith("list") else "one of "
            value = f"{kind}{', '.join(self.choices)}{more}"
            return ", or ".join((value, *(f'"{word}"' for word in self.words)))
        article = "" if self.type == _TYPES[bool] else "a "
        comma = "" if not self.range or self.range.startswith("from") else ","
        value = f"{article}{self.type}{comma} {self.range}".rstrip()
        return ", or ".join((value, *(f'"{word}"' for word in self.words)))


@dataclass(frozen=True)
class Setting:
    """One key of a section, with its documentation.

    Attributes:
        key: its name.
        accepted: the values that it accepts.
        default: its value in TOML; None if the setting is required, "" if it is unset by default.
        unit: "1" for a dimensionless number, "" for other values.
        meaning: its description.
        example: a value in TOML, for a setting that is unset by default.
    """

    key: str
    accepted: Accepted
    default: str | None
    unit: str
    meaning: str
    example: str


def sections_of(config: type[BaseModel]) -> Iterator[tuple[str, type[BaseModel]]]:
    """Yield the sections of a configuration, each before those in it: name and class."""
    for name, field in config.model_fields.items():
        if section := section_of(field):
            yield name, section
            yield from ((f"{name}.{inner}", found) for inner, found in sections_of(section))


def section_of(field: FieldInfo) -> type[BaseModel] | None:
    """Return the class of a field that is a section; None for a setting."""
    kind = field.annotation
    return kind if isinstance(kind, type) and issubclass(kind, BaseModel) else None


def settings_of(section: type[BaseModel]) -> Iterator[Setting]:
    """Yield the settings of a section in their order, without those of sections in it."""
    for key, field in section.model_fields.items():
        if section_of(field):
            continue
        extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
        if field.is_required():
            default = None
        else:
            default = "" if field.default is None else toml(field.default)
        yield Setting(
            key,
            accepted_by(field),
            default,
            str(extra.get("unit", "")),
            field.description or "",
            toml(field.examples[0]) if field.examples else "",
        )


def is_number(setting: Setting) -> bool:
    """Return whether a setting is a number or a list of numbers."""
    return "number" in setting.accepted.type


def accepted_by(field: FieldInfo) -> Accepted:
    """Return what a field accepts."""
    return _accepted(field.annotation, field.metadata)


def _accepted(annotation: Any, metadata: Sequence[Any] = ()) -> Accepted:
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        inner: list[Any] = []
        for each in arguments[1:]:
            inner += each.metadata if isinstance(each, FieldInfo) else [each]
        return _accepted(arguments[0], [*inner, *metadata])
    if origin in (Union, UnionType):
        first, *others = (each for each in arguments if each is not NoneType)
        words = tuple(word for each in others for word in get_args(each))
        return replace(_accepted(first, metadata), words=words)
    if origin is Literal:
        return Accepted("string", choices=arguments)
    if origin is tuple:
        return _accepted_list(arguments)
    named = [each for each in metadata if isinstance(each, _NAMED)]
    if named:
        return Accepted("string", choices=named[0].names, open=isinstance(named[0], KnownName))
    kind = "table" if origin is dict else _TYPES.get(annotation, "value")
    return Accepted(kind, _range(metadata))


def _accepted_list(arguments: Sequence[Any]) -> Accepted:
    item = _accepted(arguments[0])
    limits = f"{item.range} each" if item.range else ""
    if arguments[-1] is Ellipsis:
        return Accepted(f"list of {item.type}s", limits, item.choices, item.open)
    return Accepted(f"list of {_COUNTS[len(arguments)]} {item.type}s", limits)


def _range(metadata: Sequence[Any]) -> str:
    """Return the limits of a number, such as "at least 0 and below 1"."""
    found: dict[type, Any] = {type(each): each for each in metadata}
    low, above = found.get(Ge), found.get(Gt)
    high, below = found.get(Le), found.get(Lt)
    if low and high:
        return f"from {_number(low.ge)} to {_number(high.le)}"
    limits = [
        f"at least {_number(low.ge)}" if low else "",
        f"above {_number(above.gt)}" if above else "",
        f"at most {_number(high.le)}" if high else "",
        f"below {_number(below.lt)}" if below else "",
    ]
    return " and ".join(filter(None, limits))


def _number(value: Any) -> str:
    return "2^63" if value == 2**63 else f"{value:g}"
