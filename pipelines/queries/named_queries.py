"""Queries that ship with curate: pipelines/queries/NAME.sql, described by their first line.

They use only SQL that both SQLite and PostgreSQL understand. A description that ends in "(working
database)" marks a query of tables that an exported file does not have.

Queries that count all labels select their columns in a common table expression that is
MATERIALIZED: SQLite then reads only the tables of these columns. In a query that counts the rows of
the view itself, it looks up the evidence of every label.
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
        name: the value of `--named`.
        description: one sentence.
        exported: whether it also runs on an exported label file.
        sql: one SELECT.
    """

    name: str
    description: str
    exported: bool
    sql: str

    @property
    def filters(self) -> tuple[str, ...]:
        """The columns "policy" and "round", as far as the tables of the query have them."""
        return tuple(
            name
            for name in ("policy", "round")
            if any(name in columns for columns in self._sources().values())
        )

    def filtered(
        self, policy: str | None, round_number: int | None, *, postgresql: bool = False
    ) -> str:
        """Return the query restricted to the rows of a policy and a round.

        A common table expression of the same name replaces each table or view with such a column:
        `WITH weighted_labels AS (SELECT * FROM main.weighted_labels WHERE policy = 'pspsl') ...`.
        SQLite needs `main.`, or else the expression refers to itself; PostgreSQL does not know it.

        Args:
            policy: None for all.
            round_number: None for all.
            postgresql: whether a PostgreSQL server runs it.

        Raises:
            ConfigError: if no table of the query has a policy, or a round.
        """
        given = {"policy": _quoted(policy), "round": round_number}
        values = {name: value for name, value in given.items() if value is not None}
        for name in values:
            if name not in self.filters:
                raise ConfigError(f"--{name}: the query '{self.name}' has no column {name}")
        selections = []
        for source, columns in self._sources().items():
            conditions = [f"{name} = {value}" for name, value in values.items() if name in columns]
            if conditions:
                table = source if postgresql else f"main.{source}"
                chosen = f"SELECT * FROM {table} WHERE {' AND '.join(conditions)}"  # noqa: S608
                selections.append(f"{source} AS ({chosen})")
        if not selections:
            return self.sql
        rest = self.sql.removeprefix("WITH ")
        return f"WITH {', '.join(selections)}{' ' if rest == self.sql else ', '}{rest}"

    def _sources(self) -> Mapping[str, frozenset[str]]:
        """Return the columns of each table and view that the query reads."""
        schema = {each.name: each for each in working_schema()}
        return {
            name: frozenset(column.name for column in schema[name].columns)
            for name in dict.fromkeys(_SOURCE.findall(self.sql))
            if name in schema
        }


def named_queries() -> Mapping[str, NamedQuery]:
    """Return all queries that ship with curate, by name."""
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
        ConfigError: if the name is unknown.
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
