"""Tests that Open3D is loaded in one place, and that a failure says what to install."""

import re
import subprocess
import sys

import pytest
from support.paths import ROOT

from curate.errors import ConfigError
from curate.simulation import open3d_loader


def test_the_loaded_module_casts_rays():
    """The module that comes back has the part of Open3D that the simulation needs."""
    scene = open3d_loader.load().t.geometry.RaycastingScene(nthreads=1)
    assert scene.add_triangles is not None


def test_a_fresh_process_can_load_it():
    """No other import has to come first."""
    code = "from curate.simulation.open3d_loader import load; print(load().__name__)"
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert ended.stdout.strip() == "open3d"


@pytest.mark.parametrize(
    ("reason", "remedy"),
    [
        (
            "libusb-1.0.so.0: cannot open shared object file: No such file or directory",
            "apt-get install libusb-1.0-0",
        ),
        ("libEGL.so.1: cannot open shared object file: No such file", "apt-get install libegl1"),
        ("libodd++.so.3: cannot open shared object file", "libodd++.so.3"),
        ("No module named 'open3d'", "pip install open3d"),
        ("something\nover two lines", "something over two lines"),
    ],
)
def test_a_failure_names_the_remedy(monkeypatch, reason, remedy):
    """An import that fails becomes one line that says which library is missing."""

    class Refusal:
        def find_spec(self, name, path=None, target=None):
            if name == "open3d":
                raise ImportError(reason)

    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Refusal(), *sys.meta_path])
    with pytest.raises(ConfigError) as caught:
        open3d_loader.load()
    assert remedy in str(caught.value)
    assert "\n" not in str(caught.value)


def test_only_the_loader_imports_open3d():
    """Everything else asks the loader, which brings the missing library."""
    pattern = re.compile(r"^\s*(import|from) open3d\b", re.MULTILINE)
    folders = (ROOT / name for name in ("curate", "db", "pipelines"))
    sources = [path for folder in folders for path in folder.rglob("*.py")]
    found = {path.name for path in sources if pattern.search(path.read_text(encoding="utf-8"))}
    assert found == {"open3d_loader.py"}
