"""Queries that ship with curate: pipelines/queries/NAME.sql, described by their first line.

They use what SQLite and PostgreSQL have in common. Those with a description that ends in "(working
database)" need tables that an exported file does not have.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files

from curate.errors import ConfigError
from curate.spelling import did_you_mean
from pipelines.queries.schema import working_schema

_WORKING_ONLY = " (working database)"
_SOURCE = re.compile(r"\b(?:FROM|JOIN)\s+([a-z_]+)")


@dataclass(frozen=True)
class NamedQuery:
    """A query that ships with curate.

    Attributes:
        name: after `--named`.
        description: one sentence.
        exported: whether it runs on an exported label file too.
        sql: one SELECT.
    """

    name: str
    description: str
    exported: bool
    sql: str

    @property
    def filters(self) -> tuple[str, ...]:
        """Return which of "policy" and "round" can select among the rows that it reads."""
        return tuple(
            name
            for name in ("policy", "round")
            if any(name in columns for columns in self._sources().values())
        )

    def selecting(
        self, policy: str | None, round_number: int | None, *, postgresql: bool = False
    ) -> str:
        """Return the SQL that reads only the rows of a policy and a round.

        Each table or view with such a column is replaced by a selection of the same name:
        `WITH weighted_labels AS (SELECT * FROM main.weighted_labels WHERE policy = 'pspsl') ...`.
        SQLite needs the `main.`, or the selection would read itself; a server must not have it.

        Args:
            policy: None for all.
            round_number: None for all.
            postgresql: whether a PostgreSQL server runs it.

        Raises:
            ConfigError: if nothing that the query reads belongs to a policy, or to a round.
        """
        wanted = {"policy": _quoted(policy), "round": round_number}
        wanted = {name: value for name, value in wanted.items() if value is not None}
        for name in wanted:
            if name not in self.filters:
                raise ConfigError(f"--{name}: the query '{self.name}' has no {name} to select")
        selections = []
        for source, columns in self._sources().items():
            conditions = [f"{name} = {wanted[name]}" for name in wanted if name in columns]
            if conditions:
                table = source if postgresql else f"main.{source}"
                chosen = f"SELECT * FROM {table} WHERE {' AND '.join(conditions)}"  # noqa: S608
                selections.append(f"{source} AS ({chosen})")
        if not selections:
            return self.sql
        own = self.sql.removeprefix("WITH ")
        return f"WITH {', '.join(selections)}{' ' if own == self.sql else ', '}{own}"

    def _sources(self) -> Mapping[str, frozenset[str]]:
        """Return the columns of each table and view that the query reads."""
        schema = {each.name: each for each in working_schema()}
        return {
            name: frozenset(column.name for column in schema[name].columns)
            for name in dict.fromkeys(_SOURCE.findall(self.sql))
            if name in schema
        }


def named_queries() -> Mapping[str, NamedQuery]:
    """Return all of them, by name."""
    found = {}
    for path in sorted(
        files("pipelines").joinpath("queries").iterdir(), key=lambda each: each.name
    ):
        name, _, ending = path.name.rpartition(".")
        if ending == "sql":
            found[name] = _read(name, path.read_text(encoding="utf-8"))
    return found


def find_query(name: str) -> NamedQuery:
    """Return the query of that name.

    Raises:
        ConfigError: if there is none.
    """
    queries = named_queries()
    if name not in queries:
        raise ConfigError(
            f"no query is named '{name}': "
            f"use one of {', '.join(queries)}{did_you_mean(name, queries)}"
        )
    return queries[name]


def _read(name: str, text: str) -> NamedQuery:
    comment, _, sql = text.partition("\n")
    description = comment.removeprefix("-- ").removesuffix(".")
    exported = not description.endswith(_WORKING_ONLY)
    return NamedQuery(name, description.removesuffix(_WORKING_ONLY), exported, sql.strip())


def _quoted(text: str | None) -> str | None:
    return None if text is None else "'" + text.replace("'", "''") + "'"
