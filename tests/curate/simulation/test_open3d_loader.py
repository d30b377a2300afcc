"""Open3D is imported in one module, and a failure says what to install."""

import re
import subprocess
import sys

import pytest
from support.paths import ROOT

from curate.errors import ConfigError
from curate.simulation import open3d_loader, system_libraries


def test_the_loaded_module_casts_rays():
    """It has the part of Open3D that the simulation needs."""
    scene = open3d_loader.load().t.geometry.RaycastingScene(nthreads=1)
    assert scene.add_triangles is not None


def test_a_new_process_can_load_it():
    """No other import has to come first."""
    code = "from curate.simulation.open3d_loader import load; print(load().__name__)"
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert ended.stdout.strip() == "open3d"


def fail_to_load(monkeypatch: pytest.MonkeyPatch, error: ImportError) -> str:
    """Return the message of the loader if the import of open3d raises an error."""

    class Failing:
        def find_spec(self, name, path=None, target=None):
            if name == "open3d":
                raise error

    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Failing(), *sys.meta_path])
    with pytest.raises(ConfigError) as caught:
        open3d_loader.load()
    assert "\n" not in str(caught.value)
    return str(caught.value)


NO_EGL = "libEGL.so.1: cannot open shared object file: No such file or directory"


def test_a_failure_lists_all_missing_libraries(monkeypatch):
    """The linker reports the first; the message has all of them and one command."""
    lacking = {"libEGL.so.1", "libidn2.so.0"}
    monkeypatch.setattr(system_libraries, "loads", lambda library: library not in lacking)
    message = fail_to_load(monkeypatch, ImportError(NO_EGL))
    assert "libEGL.so.1, libidn2.so.0" in message
    assert "`apt-get install libegl1 libidn2-0` as root" in message


def test_a_failure_for_another_reason_is_quoted(monkeypatch):
    """No library of the table is missing, so the message quotes the linker."""
    monkeypatch.setattr(system_libraries, "loads", lambda _: True)
    assert "something over two lines" in fail_to_load(
        monkeypatch, ImportError("something\nover two lines")
    )


def test_a_missing_package_is_reported(monkeypatch):
    """With the command that installs it."""
    error = ModuleNotFoundError("No module named 'open3d'", name="open3d")
    assert "pip install open3d-cpu" in fail_to_load(monkeypatch, error)


def test_only_the_loader_imports_open3d():
    """It provides the missing library."""
    pattern = re.compile(r"^\s*(import|from) open3d\b", re.MULTILINE)
    folders = (ROOT / name for name in ("curate", "db", "pipelines"))
    sources = [path for folder in folders for path in folder.rglob("*.py")]
    found = {path.name for path in sources if pattern.search(path.read_text(encoding="utf-8"))}
    assert found == {"open3d_loader.py"}
