"""Tests of exports that are a folder: two at once, and what a killed one leaves."""

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


def test_two_exports_to_one_place_do_not_mix(tmp_path):
    """Another process that is done in the middle takes nothing away; the last one stands."""

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
def test_only_what_a_killed_export_left_is_removed(tmp_path, runs):
    """A process that still runs goes on with its own."""
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    process = os.getppid() if runs else ended.pid
    left = tmp_path / f".out.{socket.gethostname()}-{process}.partial"
    left.mkdir()
    write_folder(tmp_path / "out", "toy", lambda _: {})
    assert left.exists() == runs
