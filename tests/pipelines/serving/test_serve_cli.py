"""`curate serve` as a command: start, address, end, and one-line errors."""

import os
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import pytest
from sqlalchemy import URL
from support.paths import ROOT
from support.pipelines_cli import Curate

from curate.errors import ConfigError, DatabaseError, WorkspaceError
from pipelines.serving import sources
from pipelines.workspace.workspace import Workspace


def has_datasette() -> bool:
    """Return whether the extra is installed."""
    from importlib.util import find_spec

    return find_spec("datasette") is not None


needs_datasette = pytest.mark.skipif(
    not has_datasette(), reason="the extra [serve] is not installed"
)


@needs_datasette
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_until_it_is_stopped(weighted: Workspace, end: signal.Signals) -> None:
    """Without further output, and the port is free again."""
    command = [sys.executable, "-m", "pipelines", "serve", str(weighted.root), "--port", "0"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as server:
        lines = [server.stdout.readline() for _ in range(3)]
        url = lines[-1].split()[2]
        assert "until Ctrl-C" in lines[-1]
        with urllib.request.urlopen(url, timeout=60) as response:  # noqa: S310
            assert response.status == 200
        server.send_signal(end)
        _, err = server.communicate(timeout=60)
    assert err == ""
    assert server.returncode in {0, -signal.SIGTERM}
    assert server.returncode == 0 or end == signal.SIGTERM


@needs_datasette
def test_a_port_in_use_gives_a_one_line_error(curate: Curate, weighted: Workspace) -> None:
    """It says what to do."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, out, err = curate("serve", weighted.root, "--port", port)
    assert (code, out) == (ConfigError.exit_code, "")
    assert f"127.0.0.1:{port}" in err
    assert "--port" in err
    assert err.count("\n") == 1


@needs_datasette
def test_a_host_of_another_machine_gives_a_one_line_error(
    curate: Curate, weighted: Workspace
) -> None:
    """As a name and as an address."""
    for host in ("192.0.2.1", "nowhere.invalid"):
        code, _, err = curate("serve", weighted.root, "--host", host)
        assert code == ConfigError.exit_code
        assert host in err
        assert err.count("\n") == 1


@needs_datasette
def test_a_file_that_is_not_a_database_gives_a_one_line_error(
    curate: Curate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Missing, invalid, or a folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.sqlite").write_text("not a database at all, but long enough" * 9)
    for name, error in (
        ("notes.sqlite", DatabaseError), ("gone.sqlite", ConfigError), (".", ConfigError)
    ):  # fmt: skip
        code, _, err = curate("serve", "--file", name)
        assert code == error.exit_code, name
        assert err.count("\n") == 1


def test_the_missing_extra_is_reported(
    curate: Curate, weighted: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the command that installs it."""
    monkeypatch.setitem(sys.modules, "datasette.app", None)
    code, _, err = curate("serve", weighted.root)
    assert code == ConfigError.exit_code
    assert "pip install 'curate-pseudo-labels[serve]'" in err
    assert err.count("\n") == 1


def test_a_workspace_cannot_be_specified_twice(curate: Curate, weighted: Workspace) -> None:
    """As argument and as option."""
    code, _, err = curate("serve", weighted.root, "-w", weighted.root)
    assert code == ConfigError.exit_code
    assert "once" in err


def test_a_postgresql_workspace_serves_its_export(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without one, the error contains the command that writes it."""
    url = URL.create("postgresql+psycopg", host="db", database="labels")
    stub = SimpleNamespace(root=tmp_path, database=SimpleNamespace(url=url))
    monkeypatch.setattr(sources.Workspace, "open", lambda _folder: stub)
    with pytest.raises(WorkspaceError, match="curate export"):
        sources.choose(tmp_path, None, None)
    (tmp_path / "exports").mkdir()
    (tmp_path / "exports" / "labels.sqlite").write_bytes(b"")
    served = sources.choose(tmp_path, None, None)
    assert list(served.files) == ["labels"]
    assert served.working is None
