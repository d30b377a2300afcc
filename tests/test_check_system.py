"""The check that `make venv` runs first, on systems with missing parts."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT

CHECK = ROOT / ".ci" / "check_system.py"
# Runs the check as on another system: what it looks up is replaced before.
RUN = """
import builtins, ctypes, importlib.util, os, runpy, shutil, sys
find_spec, which, CDLL = importlib.util.find_spec, shutil.which, ctypes.CDLL
lacking = {lacking!r}
importlib.util.find_spec = lambda name: None if name in lacking else find_spec(name)
shutil.which = lambda name: None if name in lacking else {folder!r} + '/' + name
def load(name):
    if name in lacking:
        raise OSError(name)
ctypes.CDLL = load
os.geteuid = lambda: {user}
sys.platform = {platform!r}
sys.version_info = {version!r}
sys.version = '.'.join(map(str, sys.version_info))
sys.argv = ['check_system.py', *{arguments!r}]
runpy.run_path({check!r}, run_name='__main__')
"""
# In place of apt-get: records how it was called.
APT = '#!/bin/sh\necho "$DEBIAN_FRONTEND $*" >> "$(dirname "$0")/calls"\n'


def run_check(
    folder: Path,
    *arguments: str,
    lacking: tuple[str, ...] = (),
    user: int = 1000,
    platform: str = "linux",
    version: tuple[int, ...] = (3, 11, 2),
    apt: str = APT,
) -> tuple[int, str, str]:
    """Return exit status, message, and how apt-get was called."""
    (folder / "apt-get").write_text(apt)
    (folder / "apt-get").chmod(0o755)
    code = RUN.format(
        lacking=lacking, folder=str(folder), user=user, platform=platform, version=version,
        arguments=arguments, check=str(CHECK),
    )  # fmt: skip
    ended = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PATH": f"{folder}{os.pathsep}{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "Traceback" not in ended.stderr
    calls = folder / "calls"
    return ended.returncode, ended.stderr, calls.read_text() if calls.exists() else ""


def test_a_complete_system_passes_silently(tmp_path: Path) -> None:
    """Nothing is printed or installed."""
    assert run_check(tmp_path) == (0, "", "")


def test_an_old_python_is_rejected_in_one_line(tmp_path: Path) -> None:
    """With its version and the command to run."""
    status, message, calls = run_check(
        tmp_path, version=(3, 10, 12), user=0, lacking=("ensurepip",)
    )
    assert (status, calls) == (1, "")
    assert message.startswith("error: curate needs Python 3.11 or newer; ")
    assert "is 3.10.12. Name a newer one: make PYTHON=python3.12 venv\n" in message
    assert message.count("\n") == 1


MISSING = ("ensurepip", "libEGL.so.1", "libGL.so.1", "libX11.so.6")


def test_one_command_lists_everything_missing(tmp_path: Path) -> None:
    """For a user who is not root."""
    status, message, calls = run_check(tmp_path, lacking=MISSING)
    assert (status, calls) == (1, "")
    assert (
        "sudo apt-get update && sudo apt-get install -y python3.11-venv libegl1 libgl1 libx11-6\n"
        in message
    )
    assert "make venv SIMULATION=no" in message


def test_root_installs_everything_missing(tmp_path: Path) -> None:
    """Without questions, and with one line of output."""
    status, message, calls = run_check(tmp_path, lacking=MISSING, user=0)
    assert status == 0
    assert message == "Installing with apt-get: python3.11-venv libegl1 libgl1 libx11-6\n"
    update, install = calls.splitlines()
    assert update == "noninteractive update -qq"
    assert install.startswith("noninteractive install -y ")
    assert install.endswith(" python3.11-venv libegl1 libgl1 libx11-6")


def test_a_failed_installation_is_reported(tmp_path: Path) -> None:
    """With the message of apt-get."""
    apt = "#!/bin/sh\necho 'E: no network'\nexit 100\n"
    status, message, _ = run_check(tmp_path, lacking=("libGL.so.1",), user=0, apt=apt)
    assert status == 1
    assert "E: no network" in message
    assert "`apt-get update -qq` failed" in message


def test_a_system_without_apt_gets_the_list_of_libraries(tmp_path: Path) -> None:
    """Package names of other systems are not known here."""
    lacking = ("apt-get", "ensurepip", "libGL.so.1")
    status, message, _ = run_check(tmp_path, lacking=lacking, user=0)
    assert status == 1
    assert "lacks Python's venv module, libGL.so.1. Install them" in message


@pytest.mark.parametrize(
    ("arguments", "platform"), [(("--without-simulation",), "linux"), ((), "darwin")]
)
def test_libraries_are_not_needed(tmp_path: Path, arguments: tuple[str, ...], platform: str):
    """Without simulation, or if the wheel contains them."""
    assert run_check(tmp_path, *arguments, lacking=("libGL.so.1",), platform=platform) == (
        0,
        "",
        "",
    )


def test_the_venv_module_is_needed_without_simulation_too(tmp_path: Path) -> None:
    """There is no alternative."""
    status, message, _ = run_check(tmp_path, "--without-simulation", lacking=("ensurepip",))
    assert status == 1
    assert "python3.11-venv" in message
    assert "SIMULATION" not in message
