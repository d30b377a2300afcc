"""Where a workspace and its database are, without opening either."""

from pathlib import Path

from sqlalchemy import URL

from curate.errors import WorkspaceError
from db.addresses import parse_url
from pipelines.workspace.config import Config, read_config

CONFIG_NAME = "curate.toml"


def find_workspace(folder: Path | None) -> Path:
    """Return the folder of a workspace: `folder`, or else the nearest one at or above the current.

    Raises:
        WorkspaceError: if there is no workspace.
    """
    if folder is not None:
        root = folder.resolve()
        if not (root / CONFIG_NAME).is_file():
            raise WorkspaceError(f"{root}: no workspace here; create one with `curate init {root}`")
        return root
    here = Path.cwd()
    for root in (here, *here.parents):
        if (root / CONFIG_NAME).is_file():
            return root
    raise WorkspaceError(
        f"no {CONFIG_NAME} in {here} or above it; create a workspace with `curate init "
        "DIR`, or specify one with --workspace DIR"
    )


def url_of(root: Path, config: Config) -> URL:
    """Return the URL of the database of a workspace with this configuration."""
    if config.run.database is not None:
        return parse_url(config.run.database)
    # Built from parts: in a URL string, a ? or % in the folder's name has a special meaning.
    return URL.create("sqlite", database=str(root / "curate.db"))


def database_url(folder: Path | None) -> URL:
    """Return the URL of a workspace's database, without opening or migrating it."""
    root = find_workspace(folder)
    return url_of(root, read_config(root / CONFIG_NAME))
