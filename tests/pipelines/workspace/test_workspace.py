"""A workspace with settings of one command."""

import os
from pathlib import Path

import pytest

from curate.errors import ConfigError, WorkspaceError
from db.addresses import parse_url
from pipelines.engine.rounds import (
    find_teacher,
    newest_checkpoint,
    open_round,
    register_checkpoint,
    stored_round,
)
from pipelines.workspace.config import read_config
from pipelines.workspace.workspace import Workspace, sha256


def test_settings_of_a_command_change_only_their_section(workspace: Workspace) -> None:
    """The other sections are the same objects."""
    changed = workspace.with_settings("run", workers=3)
    assert changed.config.run == workspace.config.run.model_copy(update={"workers": 3})
    assert changed.config.dataset is workspace.config.dataset


def test_a_wrong_setting_of_a_command_is_reported(workspace: Workspace) -> None:
    """In one line, with its origin."""
    message = r'^command line: run\.workers = 0: use a whole number, at least 1, or "auto"$'
    with pytest.raises(ConfigError, match=message):
        workspace.with_settings("run", workers=0)


def test_a_pipe_in_place_of_a_file_is_rejected(tmp_path: Path) -> None:
    """Reading it would never end; nor would a device."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for place in (pipe, Path("/dev/zero")):
        with pytest.raises(ConfigError, match="is a pipe or a device"):
            sha256(place)
        with pytest.raises(ConfigError, match="a pipe or a device"):
            read_config(place)


def test_a_checkpoint_replaced_by_a_pipe_counts_as_missing(workspace: Workspace) -> None:
    """The error says how to create it again."""
    path = workspace.root / "checkpoints" / "teacher"
    path.write_bytes(b"")
    with workspace.database.writing() as connection:
        register_checkpoint(connection, workspace, 1, workspace.config.run.method, path)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(WorkspaceError, match="the checkpoint is missing; run `curate train-round"):
        find_teacher(workspace, 2)


def test_a_replaced_checkpoint_is_not_used(workspace: Workspace) -> None:
    """Its predictions would be stored as those of the old one; with the old one back, all works."""
    path = workspace.root / "checkpoints" / "teacher"
    path.write_bytes(b"made")
    with workspace.database.writing() as connection:
        register_checkpoint(connection, workspace, 1, workspace.config.run.method, path)
    assert open_round(workspace, 2).teacher.path == path
    path.write_bytes(b"another")
    for call in (lambda: open_round(workspace, 2), lambda: newest_checkpoint(workspace)):
        with pytest.raises(WorkspaceError, match=r"has changed since .* run `curate train-round"):
            call()
    assert stored_round(workspace, 2) is not None
    path.write_bytes(b"made")
    assert newest_checkpoint(workspace) == path


def test_a_null_character_in_a_database_url_is_rejected() -> None:
    """Drivers raise their own errors for it."""
    with pytest.raises(ConfigError, match=r"run\.database: not the URL"):
        parse_url("sqlite:////tmp/a\0b")
