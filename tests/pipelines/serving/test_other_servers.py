"""`curate serve` for a single file, and for a network."""

import sqlite3
from pathlib import Path

import pytest
from support.serving import running

from pipelines.serving.sources import choose
from pipelines.workspace.workspace import Workspace

pytest.importorskip("datasette", reason="the extra [serve] is not installed")


def test_a_single_file_is_served_without_images(
    weighted: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If no workspace is near; hostile text in it is escaped."""
    path = tmp_path / "foreign.sqlite"
    path.write_bytes((weighted.root / "exports" / "labels.sqlite").read_bytes())
    evil = "<script>alert(1)</script>"
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE label SET category = ?", (evil,))
    connection.close()
    monkeypatch.chdir(tmp_path)
    served = choose(None, None, path)
    assert served.workspace is None
    with running(served, weighted) as alone:
        text = alone.get("/labels/weighted_labels").text
        assert "&lt;script&gt;alert" in text
        assert evil not in text
        assert "/-/frame?" not in text
        assert alone.get("/-/picture", frame="000003").status == 404
        assert alone.get("/workspace").status == 404


def test_an_open_host_accepts_any_host_name(weighted: Workspace) -> None:
    """The name cannot be known there; all other checks stay."""
    served = choose(weighted.root, None, None)
    with running(served, weighted, host="0.0.0.0") as open_pages:  # noqa: S104
        assert open_pages.get("/", headers={"Host": "lab.example"}).status == 200
        assert open_pages.get("/-/databases.json").status == 404
