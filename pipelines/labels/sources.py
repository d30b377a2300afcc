"""The evidence sources of a workspace: their declarations and their tables."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

from curate.errors import ConfigError
from curate.exporters.columns import WEIGHTED_LABELS
from curate.priors.base import Column, check_declaration
from curate.priors.semantic import SemanticPrior
from db import bulk
from db.evidence import OWN_TABLES, PROBABILITY, Declaration, declare, read_declarations
from db.views import create_views, drop_views
from pipelines.registry import PRIORS
from pipelines.workspace.workspace import Workspace

_log = logging.getLogger(__name__)
_RESERVED = frozenset(
    {
        *(column.name for column in (*WEIGHTED_LABELS, *SemanticPrior.camera_columns)),
        *(column.name for column in PROBABILITY.columns),
        "frame_id",
    }
)
_FRAME_MEMBERS = ("measured_columns", "measure", "rate")


@dataclass(frozen=True)
class Source:
    """An evidence source of the configuration.

    Attributes:
        configured: its name in run.priors.
        declaration: its name and its columns.
        measured_columns: names of the columns that it measures; empty for a source of sequences.
        of_sequences: whether it processes whole sequences, not single frames.
        camera_columns: further columns if frames have several cameras.
    """

    configured: str
    declaration: Declaration
    measured_columns: tuple[str, ...]
    of_sequences: bool
    camera_columns: tuple[Column, ...] = ()

    @property
    def table(self) -> str:
        """Name of the source's table."""
        return self.declaration.table


@cache
def source_of(configured: str) -> Source:
    """Return the source with a name from run.priors.

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
    core = {column.name for column in kind.columns} if configured in OWN_TABLES else set()
    check_declaration(kind, _RESERVED - core)
    if kind.name in OWN_TABLES and configured not in PRIORS.classes:
        raise ConfigError(
            f"evidence source '{configured}': the name '{kind.name}' is taken by a source of "
            "curate; give your class another name"
        )
    declaration = Declaration(kind.name, configured, tuple(kind.columns), kind.rho_column)
    measured = () if of_sequences else tuple(kind.measured_columns)
    further = tuple(kind.camera_columns) if configured in OWN_TABLES else ()
    return Source(configured, declaration, measured, of_sequences, further)


def sources_of(names: Sequence[str]) -> tuple[Source, ...]:
    """Return the sources with names from run.priors.

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


def prepare_stage(workspace: Workspace, source: Source) -> None:
    """Prepare the table of a source before its stage runs, see `prepare_table`.

    With several cameras, the column of the semantic prior's camera is declared too.
    """
    prepare_table(workspace, source)
    if source.camera_columns and _has_cameras(workspace):
        further = replace(source.declaration, columns=source.camera_columns, rho_column=None)
        _declare(workspace, further)


def _has_cameras(workspace: Workspace) -> bool:
    """Return whether the frames have several cameras."""
    dataset = workspace.dataset
    first = next(iter(dataset.frame_ids()), None)
    if first is None:
        return False
    images = dataset.files(first).images
    # A damaged image must fail its own frame, not the stage: only the paths are looked at.
    return len(images or dataset.read(first, points=False).cameras) > 1


def prepare_table(workspace: Workspace, source: Source) -> None:
    """Create the table of a source on its first use, and recreate the views with its columns.

    Raises:
        ConfigError: if another stored source has a column of the same name.
    """
    bulk.use_source(source.declaration)
    if source.declaration.name not in OWN_TABLES:
        _declare(workspace, source.declaration)


def prepare_probability(workspace: Workspace) -> None:
    """Give the view `weighted_labels` the column with the probability of each label."""
    _declare(workspace, PROBABILITY)


def _declare(workspace: Workspace, declaration: Declaration) -> None:
    database = workspace.database
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
                f"evidence source '{declaration.name}': column {min(shared)} is already stored by "
                f"source '{other.name}' ({other.table}); rename the column, or drop that table"
            )
    with database.writing() as connection:
        drop_views(connection)
        declare(connection, declaration)
        create_views(connection)
    if any(
        other.name == declaration.name and other.layout != declaration.layout for other in stored
    ):
        _log.warning(
            "evidence source '%s' has other columns than before, or is another class: table %s is "
            "replaced, and its evidence is computed again",
            declaration.name,
            declaration.table,
        )


def report_unused(workspace: Workspace) -> None:
    """Log a warning for each source with stored evidence that is no longer in run.priors."""
    active = {source_of(name).declaration.name for name in workspace.config.run.priors}
    active.add(PROBABILITY.name)
    with workspace.database.reading() as connection:
        stored = read_declarations(connection)
    for each in stored:
        if each.name not in active:
            columns = ", ".join(column.name for column in each.columns)
            _log.warning(
                "evidence source '%s' is no longer in run.priors: table %s keeps its evidence, "
                "weighted_labels still shows it (%s), but no weight uses it",
                each.name,
                each.table,
                columns,
            )


def rho_columns(names: Sequence[str]) -> dict[str, str]:
    """Return, for each prior among some sources, its trust column and its table."""
    found: dict[str | None, str] = {
        source.declaration.rho_column: source.table for source in sources_of(names)
    }
    return {column: table for column, table in found.items() if column is not None}
