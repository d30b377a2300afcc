"""The file `curate.toml`: written with a comment for every setting, and changed line by line."""

import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from functools import reduce
from operator import getitem
from pathlib import Path

from curate.errors import ConfigError
from curate.files.atomic import replace_file
from curate.files.text import read_text
from curate.files.toml_text import parse_toml, toml
from pipelines.workspace.config import Config
from pipelines.workspace.reference import Setting, sections_of, settings_of

SCHEMA_NAME = "curate.schema.json"
"""The JSON Schema beside `curate.toml`, from which editors complete it."""
_SCHEMA = Path(__file__).with_name(SCHEMA_NAME)
_HEADER = f"""\
#:schema ./{SCHEMA_NAME}
# The settings of this workspace. docs/config.md lists them with their ranges and units.
# Commented settings are unset: remove the # to set one.
"""
_WIDTH = 96


def write_config(path: Path, config: Config) -> None:
    """Write every setting with its meaning, and the JSON Schema beside it.

    Defaults are written as well: a later version of curate with other defaults does not change
    what a workspace computes.
    """
    values = config.model_dump(mode="json", exclude_none=True)
    lines: list[str] = []
    for name, section in sections_of(Config):
        lines += ["", f"[{name}]", *_comment(section.__doc__ or ""), ""]
        chosen = reduce(getitem, name.split("."), values)
        for setting in settings_of(section):
            lines += _setting_lines(setting, chosen)
    write_schema(path.parent)
    replace_file(path, (_HEADER + "\n".join(lines) + "\n").encode())


def write_schema(folder: Path) -> None:
    """Write the JSON Schema of this version of curate into the folder of a `curate.toml`."""
    replace_file(folder / SCHEMA_NAME, _SCHEMA.read_bytes())


def _setting_lines(setting: Setting, values: Mapping[str, object]) -> Iterator[str]:
    accepted = setting.accepted
    limits = str(accepted) if accepted.choices else accepted.range
    if limits:
        unit = f", in {setting.unit}" if setting.unit not in {"", "1"} else ""
        limits = f" {limits[0].upper()}{limits[1:]}{unit}."
    yield from _comment(setting.meaning + limits)
    if setting.key in values:
        yield f"{setting.key} = {toml(values[setting.key])}"
    else:
        yield f"# {setting.key} = {setting.example}"


def _comment(text: str) -> list[str]:
    wrapped = textwrap.wrap(" ".join(text.split()), _WIDTH, break_long_words=False)
    return [f"# {line}" for line in wrapped]


def change_settings(path: Path, section: str, changes: Mapping[str, str]) -> None:
    """Write settings into a section of a TOML file; all other text stays unchanged.

    Raises:
        ConfigError: if the file cannot be changed in this way; it stays unchanged.
    """
    lines = [f"{key} = {toml(value)}" for key, value in changes.items()]
    reason = "cannot be changed line by line"
    text = read_text(path, "configuration", error_type=ConfigError)
    try:
        before = parse_toml(text)
        changed = "\n".join(_changed(text.splitlines(), section, lines)) + "\n"
        expected = {**before, section: {**before.get(section, {}), **changes}}
        if parse_toml(changed) == expected:
            replace_file(path, changed.encode())
            return
    except ValueError:
        pass  # invalid TOML: the file has an inline table or a multi-line string there
    except OSError as error:
        reason = f"cannot be changed: {error.strerror}"
    raise ConfigError(f"{path}: {reason}; add to its section [{section}]: {'; '.join(lines)}")


def _changed(lines: Sequence[str], section: str, settings: Sequence[str]) -> list[str]:
    """Return the lines with each setting written.

    A setting replaces the line that sets it, or the comment that shows it as unset. If there is
    neither, it is inserted at the top of its section.
    """
    found = list(lines)
    header = re.compile(rf"\s*\[\s*{re.escape(section)}\s*\]\s*(#.*)?")
    start = next((i for i, line in enumerate(found) if header.fullmatch(line)), None)
    if start is None:
        return [*found, "", f"[{section}]", *settings]
    for setting in settings:
        key = re.escape(setting.partition(" = ")[0])
        end = next(
            (i for i in range(start + 1, len(found)) if found[i].lstrip().startswith("[")),
            len(found),
        )
        forms = (re.compile(rf"\s*{key}\s*="), re.compile(rf"#\s?{key} = "))
        places = [i for form in forms for i in range(start + 1, end) if form.match(found[i])]
        if places:
            found[places[0]] = setting
        else:
            found.insert(start + 1, setting)
    return found
