"""The evidence sources of a workspace: their declarations, and the tables that follow from them."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

from curate.errors import ConfigError
from curate.exporters.columns import WEIGHTED_LABELS
from curate.priors.base import check_declaration
from db import bulk
from db.evidence import OWN_TABLES, Declaration, declare, read_declarations
from db.views import create_views, drop_views
from pipelines.registry import PRIORS
from pipelines.workspace.workspace import Workspace

_log = logging.getLogger(__name__)
_RESERVED = frozenset({*(column.name for column in WEIGHTED_LABELS), "probability", "frame_id"})
_FRAME_MEMBERS = ("measured_columns", "measure", "rate")


@dataclass(frozen=True)
class Source:
    """An evidence source as the configuration names it.

    Attributes:
        configured: its name in run.priors.
        declaration: what it stores.
        measured_columns: those that are measured, of a source that looks at one frame.
        of_sequences: whether it looks at whole sequences.
    """

    configured: str
    declaration: Declaration
    measured_columns: tuple[str, ...]
    of_sequences: bool

    @property
    def table(self) -> str:
        """The name of its table."""
        return self.declaration.table


@cache
def source_of(configured: str) -> Source:
    """Return the source behind a name of run.priors.

    Raises:
        ConfigError: if there is no such source, or its declaration is invalid.
    """
    kind = PRIORS.load(configured)
    of_sequences = hasattr(kind, "score_sequence")
    missing = [name for name in _FRAME_MEMBERS if not (of_sequences or hasattr(kind, name))]
    if missing:
        raise ConfigError(
            f"evidence source '{configured}' has neither score_sequence nor {', '.join(missing)}; "
            "see curate.priors.base.EvidenceSource"
        )
    own = {column.name for column in kind.columns} if configured in OWN_TABLES else set()
    check_declaration(kind, _RESERVED - own)
    if kind.name in OWN_TABLES and configured not in PRIORS.classes:
        raise ConfigError(f"evidence source '{configured}': the name '{kind.name}' is taken")
    declaration = Declaration(kind.name, configured, tuple(kind.columns), kind.rho_column)
    measured = () if of_sequences else tuple(kind.measured_columns)
    return Source(configured, declaration, measured, of_sequences)


def sources_of(names: Sequence[str]) -> tuple[Source, ...]:
    """Return the sources of run.priors.

    Raises:
        ConfigError: if one is unknown or invalid, or two have the same name or a column in common.
    """
    found = tuple(map(source_of, names))
    for i, one in enumerate(found):
        for other in found[:i]:
            if one.declaration.name == other.declaration.name:
                raise ConfigError(
                    f"run.priors: {other.configured} and {one.configured} have the same name "
                    f"'{one.declaration.name}'; use one of them"
                )
            columns = {column.name for column in other.declaration.columns}
            for column in one.declaration.columns:
                if column.name in columns:
                    raise ConfigError(
                        f"run.priors: {other.configured} and {one.configured} both declare column "
                        f"{column.name}; use one of them"
                    )
    return found


def prepare_table(workspace: Workspace, source: Source) -> None:
    """Make the table of a source on its first use, and the views that show it.

    Raises:
        ConfigError: if a source that is stored already declares one of its columns.
    """
    bulk.use_source(source.declaration)
    database, declaration = workspace.database, source.declaration
    if declaration.name in OWN_TABLES:
        return
    with database.reading() as connection:
        stored = read_declarations(connection)
    if declaration in stored:
        return
    for other in stored:
        shared = {column.name for column in other.columns} & {
            column.name for column in declaration.columns
        }
        if other.name != declaration.name and shared:
            raise ConfigError(
                f"evidence source '{declaration.name}': column {min(shared)} is stored already by "
                f"source '{other.name}' ({other.table}); rename the column, or drop that table"
            )
    with database.writing() as connection:
        drop_views(connection)
        declare(connection, declaration)
        create_views(connection)
    if any(other.name == declaration.name for other in stored):
        _log.warning(
            "evidence source '%s' declares other columns than before, or is another class: table "
            "%s is made anew, and its evidence computed again",
            declaration.name,
            declaration.table,
        )


def report_unused(workspace: Workspace) -> None:
    """Warn of sources with stored evidence that run.priors does not list any more."""
    active = {source_of(name).declaration.name for name in workspace.config.run.priors}
    with workspace.database.reading() as connection:
        stored = read_declarations(connection)
    for each in stored:
        if each.name not in active:
            columns = ", ".join(column.name for column in each.columns)
            _log.warning(
                "evidence source '%s' is not in run.priors any more: %s keeps what it stored, "
                "weighted_labels shows it (%s), no weight uses it",
                each.name,
                each.table,
                columns,
            )


def rho_columns(names: Sequence[str]) -> dict[str, str]:
    """Return the trust column of each prior among some sources, with its table."""
    found: dict[str | None, str] = {
        source.declaration.rho_column: source.table for source in sources_of(names)
    }
    return {column: table for column, table in found.items() if column is not None}
