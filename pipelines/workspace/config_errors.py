"""Error messages for a configuration: which key is wrong, what it accepts, what was meant."""

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from curate.files.toml_text import toml, toml_key
from curate.spelling import did_you_mean
from pipelines.workspace.reference import Accepted, accepted_by, section_of

_LONGEST = 80  # characters of a wrong value that are shown


def describe_errors(error: ValidationError, model: type[BaseModel]) -> str:
    """Return one line that describes all errors that pydantic found in a document."""
    found: dict[str, str] = {}
    for detail in error.errors(include_url=False):
        place, message = _describe(detail, model)
        found.setdefault(place, message)  # a list with three wrong items is one error
    return "; ".join(f"{place}{message}" for place, message in found.items())


def _describe(error: ErrorDetails, model: type[BaseModel]) -> tuple[str, str]:
    """Return the key with an error, and the message to append to it."""
    path = [str(part) for part in error["loc"] if part != "[key]"]
    known, field, depth = _walk(model, path)
    if error["type"] == "extra_forbidden":
        return _unknown_key(path, model, known)
    accepted = Accepted("table") if field is None or section_of(field) else accepted_by(field)
    inside = path[depth:] if accepted.type.startswith("list") else []
    if accepted.type != "table":
        path = path[:depth]
    place = ".".join(map(toml_key, path)) or "the configuration"
    if error["type"] == "missing" and not inside:
        meaning = field.description if field else None
        return place, f" is missing{f': {meaning}' if meaning else ''}".rstrip(".")
    if error["type"] == "value_error":
        return place, f": {error['ctx']['error']}"
    value = error["input"]
    meant = did_you_mean(value, accepted.choices) if isinstance(value, str) else ""
    finite = "; it must be finite" if error["type"] == "finite_number" else ""
    wrong = f": {_shown(value)} in the list" if inside else f" = {_shown(value)}"
    return place, f"{wrong}: use {accepted}{finite}{meant}"


def _unknown_key(
    path: Sequence[str], model: type[BaseModel], known: Sequence[str]
) -> tuple[str, str]:
    """Return the key and the message for a key or a section that does not exist."""
    *section, key = path
    owner = f"[{'.'.join(section)}]" if section else "the configuration"
    noun = "key" if section else "section"
    meant = did_you_mean(key, known) or _elsewhere(key, model)
    message = f": unknown {noun}{meant}; {owner} has {', '.join(known)}"
    return ".".join(map(toml_key, path)), message


def _elsewhere(key: str, model: type[BaseModel]) -> str:
    """Suggest the sections that have a key of this name."""
    found = [
        f"{name}.{key}"
        for name, field in model.model_fields.items()
        if (section := section_of(field)) and key in section.model_fields
    ]
    return f"; did you mean {' or '.join(found)}?" if found else ""


def _walk(
    model: type[BaseModel], path: Sequence[str]
) -> tuple[Sequence[str], FieldInfo | None, int]:
    """Return the keys of the innermost section on a path, its last field, and the depth of it."""
    field, depth = None, 0
    for part in path:
        found = model.model_fields.get(part)
        if found is None:
            break
        field, depth = found, depth + 1
        inner = section_of(field)
        if inner is None:
            break
        model = inner
    return tuple(model.model_fields), field, depth


def _shown(value: Any) -> str:
    """Return a wrong value as TOML, shortened, on one line."""
    text = " ".join((toml(value) if not isinstance(value, Mapping) else "a table").split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
