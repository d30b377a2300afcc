"""The pages of `curate serve` as one ASGI application."""

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
    """The databases to serve.

    Attributes:
        title: of the pages.
        files: SQLite files by the name under which they are shown.
        working: name of the file that is a workspace's database; None if there is none.
        workspace: workspace for the pages of frames; None for no such pages.
        time_limit_s: time limit of a query.
    """

    title: str
    files: Mapping[str, Path]
    working: str | None
    workspace: Workspace | None
    time_limit_s: float = 10.0


@contextmanager
def application(served: Served, host: str) -> Iterator[Any]:
    """Yield the ASGI application; curate's plugin is registered in Datasette until the block ends.

    Raises:
        ConfigError: if Datasette is not installed.
        DatabaseError: if a file is not a database.
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

    # Plugins that a user installed for other servers may write.
    for installed, _ in pm.list_plugin_distinfo():
        pm.unregister(installed)
    # Datasette's own error handler prints a traceback with all local values.
    default_handler = pm.unregister(name="datasette.handle_exception")
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
        pm.register(default_handler, name="datasette.handle_exception")


def _metadata(served: Served) -> dict[str, Any]:
    """Return Datasette's metadata of all files."""
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
