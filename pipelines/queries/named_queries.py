"""Questions that ship with the project: pipelines/queries/NAME.sql, described by their first line.

They use what SQLite and PostgreSQL have in common. Those that end in "(working database)" need
tables that an exported file does not hold.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files

from curate.errors import ConfigError

_WORKING_ONLY = " (working database)"


@dataclass(frozen=True)
class NamedQuery:
    """A question.

    Attributes:
        name: by which people ask it.
        description: one sentence.
        exported: whether an exported label file can answer it too.
        sql: one SELECT.
    """

    name: str
    description: str
    exported: bool
    sql: str


def named_queries() -> Mapping[str, NamedQuery]:
    """All of them, by name."""
    found = {}
    for path in sorted(
        files("pipelines").joinpath("queries").iterdir(), key=lambda each: each.name
    ):
        name, _, ending = path.name.rpartition(".")
        if ending == "sql":
            found[name] = _read(name, path.read_text(encoding="utf-8"))
    return found


def find_query(name: str) -> NamedQuery:
    """The question of that name.

    Raises:
        ConfigError: there is none.
    """
    queries = named_queries()
    if name not in queries:
        raise ConfigError(f"no query is named '{name}'; use one of {', '.join(queries)}")
    return queries[name]


def _read(name: str, text: str) -> NamedQuery:
    comment, _, sql = text.partition("\n")
    description = comment.removeprefix("-- ").removesuffix(".")
    exported = not description.endswith(_WORKING_ONLY)
    return NamedQuery(name, description.removesuffix(_WORKING_ONLY), exported, sql.strip())
