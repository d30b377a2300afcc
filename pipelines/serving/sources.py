"""Choose the databases that a server shows."""

from pathlib import Path

from curate.errors import ConfigError, WorkspaceError
from pipelines.serving.application import Served
from pipelines.workspace.workspace import Workspace

WORKING, EXPORTED = "workspace", "labels"


def choose(argument: Path | None, option: Path | None, file: Path | None) -> Served:
    """Return what the command line selects.

    Args:
        argument: the workspace as an argument.
        option: the workspace as an option.
        file: an exported label file; then a workspace only adds images.

    Raises:
        ConfigError: if both specify a workspace, or there is no such file.
        WorkspaceError: if there is no workspace, or it has nothing to serve.
    """
    if argument is not None and option is not None:
        raise ConfigError("serve: specify the workspace once, as an argument or with --workspace")
    folder = argument or option
    if file is None:
        return _of_workspace(Workspace.open(folder))
    if not file.is_file():
        raise ConfigError(f"--file {file}: no such file; `curate export` writes one")
    return Served(file.name, {EXPORTED: file}, None, _find_workspace(folder))


def _of_workspace(workspace: Workspace) -> Served:
    url, exported = workspace.database.url, workspace.root / "exports" / "labels.sqlite"
    files = {}
    if url.get_backend_name() == "sqlite":
        files[WORKING] = Path(str(url.database))
    if exported.is_file():
        files[EXPORTED] = exported
    if not files:
        raise WorkspaceError(
            f"serve: Datasette reads SQLite, and {workspace.root} stores its rows in "
            f"{url.get_backend_name()}; write exports/labels.sqlite with `curate export`"
        )
    working = WORKING if WORKING in files else None
    return Served(f"curate: {workspace.root.name}", files, working, workspace)


def _find_workspace(folder: Path | None) -> Workspace | None:
    """Return the workspace for images; None if none is specified and none is found."""
    if folder is not None:
        return Workspace.open(folder)
    try:
        return Workspace.open()
    except WorkspaceError:
        return None
