"""The pages as one ASGI application."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from curate.errors import ConfigError
from db.evidence import Declaration, read_declarations
from pipelines.serving import descriptions
from pipelines.workspace.workspace import Workspace

_SETTINGS = {
    "max_returned_rows": 1000,
    "allow_download": False,
    "allow_csv_stream": False,
    "suggest_facets": False,
    "default_cache_ttl": 0,
    "max_csv_mb": 10,
    "truncate_cells_html": 300,
}


@dataclass(frozen=True)
class Served:
    """What is served.

    Attributes:
        title: of the pages.
        files: SQLite files by the name under which they are shown.
        working: the name of the one that is a workspace's database, None for none of them.
        workspace: for pictures; None for no pictures.
        time_limit_s: of a question.
    """

    title: str
    files: Mapping[str, Path]
    working: str | None
    workspace: Workspace | None
    time_limit_s: float = 10.0


@contextmanager
def application(served: Served, host: str) -> Iterator[Any]:
    """The ASGI application; until the end of the block curate's hooks are in Datasette.

    Raises:
        ConfigError: Datasette is not installed.
        DatabaseError: if a file is no database.
    """
    try:
        from datasette.app import Datasette
        from datasette.plugins import pm
    except ImportError as error:
        raise ConfigError(
            "serve: Datasette is not installed; pip install 'curate-pseudo-labels[serve]'"
        ) from error
    from pipelines.serving.plugin import NAME, CuratePlugin
    from pipelines.serving.read_only import ReadOnlyDatabase, connect_read_only
    from pipelines.serving.shown_frames import FramePages

    # Whatever plugins a user has installed for other servers: some of them write.
    for foreign, _ in pm.list_plugin_distinfo():
        pm.unregister(foreign)
    # Its own pages of errors come with a trace in the terminal, all local values included.
    talkative = pm.unregister(name="datasette.handle_exception")
    frames = None if served.workspace is None else FramePages(served.workspace)
    plugin = CuratePlugin(host, frames)
    pm.register(plugin, name=NAME)
    try:
        settings = _SETTINGS | {"sql_time_limit_ms": round(1000 * served.time_limit_s)}
        datasette = Datasette([], memory=False, metadata=_metadata(served), settings=settings)
        datasette.remove_database("_memory")
        for name, path in served.files.items():
            connect_read_only(path).close()
            datasette.add_database(ReadOnlyDatabase(datasette, path), name=name)
        yield datasette.app()
    finally:
        pm.unregister(plugin)
        pm.register(talkative, name="datasette.handle_exception")


def _metadata(served: Served) -> dict[str, Any]:
    """What Datasette says of all of it."""
    declared: Sequence[Declaration] = ()
    if served.working and served.workspace:
        with served.workspace.database.reading() as connection:
            declared = read_declarations(connection)
    return {
        "title": served.title,
        "databases": {
            name: (
                descriptions.working_database(declared)
                if name == served.working
                else descriptions.exported_file(path)
            )
            for name, path in served.files.items()
        },
    }
