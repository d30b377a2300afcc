"""Single settings in a configuration file: changed line by line, all else stays as it was typed."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from curate.errors import ConfigError
from curate.files.atomic import replace_file
from curate.files.toml_text import parse_toml
from pipelines.workspace.config import toml


def change_settings(path: Path, section: str, changes: Mapping[str, str]) -> None:
    """Writes settings into a section of a TOML file.

    Raises:
        ConfigError: the file cannot be changed in this way, which leaves it as it was.
    """
    lines = [f"{key} = {toml(value)}" for key, value in changes.items()]
    fault = "cannot be changed line by line"
    try:
        text = path.read_text(encoding="utf-8-sig")
        before = parse_toml(text)
        changed = "\n".join(_changed(text.splitlines(), section, lines)) + "\n"
        wanted = {**before, section: {**before.get(section, {}), **changes}}
        if parse_toml(changed) == wanted:
            replace_file(path, changed.encode())
            return
    except ValueError:
        pass  # what was written is no TOML: a table in braces, or a text over several lines
    except OSError as error:
        fault = f"cannot be changed: {error.strerror}"
    raise ConfigError(f"{path}: {fault}; write into its [{section}] yourself: {'; '.join(lines)}")


def _changed(lines: Sequence[str], section: str, settings: Sequence[str]) -> list[str]:
    """The lines with each setting in the place of its former line, else on top of its section."""
    found = list(lines)
    header = re.compile(rf"\s*\[\s*{re.escape(section)}\s*\]\s*(#.*)?")
    start = next((i for i, line in enumerate(found) if header.fullmatch(line)), None)
    if start is None:
        return [*found, "", f"[{section}]", *settings]
    for setting in settings:
        key = setting.partition(" = ")[0]
        end = next(
            (i for i in range(start + 1, len(found)) if found[i].lstrip().startswith("[")),
            len(found),
        )
        own = re.compile(rf"\s*{re.escape(key)}\s*=")
        places = [i for i in range(start + 1, end) if own.match(found[i])]
        if places:
            found[places[0]] = setting
        else:
            found.insert(start + 1, setting)
    return found
