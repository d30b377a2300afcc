"""Exports into a folder: two at once, and the remains of a killed one."""

import json
import os
import socket
import subprocess
import sys

import pytest

from curate.exporters.folder import write_folder

OTHER = """
import sys
from pathlib import Path
from curate.exporters.folder import write_folder
write_folder(Path(sys.argv[1]), "toy", lambda folder: (folder / "other").write_text("") or {})
"""


def test_two_exports_to_one_folder_do_not_mix(tmp_path):
    """Another process that finishes first loses nothing; the last one stays."""

    def fill(folder):
        (folder / "first").write_text("")
        subprocess.run([sys.executable, "-c", OTHER, tmp_path / "out"], check=True)
        assert (tmp_path / "out" / "other").exists()
        (folder / "second").write_text("")
        return {}

    write_folder(tmp_path / "out", "toy", fill)
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["export.json", "first", "second"]
    assert json.loads((tmp_path / "out" / "export.json").read_text()) == {"format": "toy"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("runs", [True, False])
def test_only_the_remains_of_a_killed_export_are_removed(tmp_path, runs):
    """Those of a running process stay."""
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    process = os.getppid() if runs else ended.pid
    left = tmp_path / f".out.{socket.gethostname()}-{process}.partial"
    left.mkdir()
    write_folder(tmp_path / "out", "toy", lambda _: {})
    assert left.exists() == runs
