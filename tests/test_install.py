"""The line of progress of `make venv`, with a pip that prints what it is told to."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT

INSTALL = ROOT / ".ci" / "install.py"
# In place of pip: writes a file of one megabyte, prints lines, and ends with a status.
PIP = """
import os, pathlib, sys, sysconfig
place = pathlib.Path(sysconfig.get_path("purelib"))
place.joinpath("data.bin").write_bytes(bytes(1_000_000))
place.joinpath("arguments").write_text(" ".join(sys.argv[1:]))
print(os.environ["PIP_PRINTS"])
sys.exit(int(os.environ["PIP_STATUS"]))
"""


@pytest.fixture
def environment(tmp_path: Path) -> Path:
    """Return a virtual environment without pip, and write the pip that takes its place."""
    (tmp_path / "stand-in" / "pip").mkdir(parents=True)
    (tmp_path / "stand-in" / "pip" / "__main__.py").write_text(PIP)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    return tmp_path / "venv"


def install(
    environment: Path, *arguments: str, prints: str = "", status: int = 0
) -> "subprocess.CompletedProcess[str]":
    variables = {
        "PYTHONPATH": str(environment.parent / "stand-in"),
        "PIP_PRINTS": prints,
        "PIP_STATUS": str(status),
    }
    command = [environment / "bin" / "python", INSTALL, *arguments]
    return subprocess.run(command, env=variables, capture_output=True, text=True, check=False)


def arguments_of_pip(environment: Path) -> str:
    return next(environment.glob("lib/*/site-packages/arguments")).read_text()


def test_the_last_line_says_how_much_was_installed(environment: Path) -> None:
    ended = install(environment, "10", "torch==2.13.0", prints="Collecting torch\nInstalling")

    assert ended.returncode == 0
    assert ended.stdout.startswith("  1 MB in ")
    assert ended.stdout.count("\n") == 1
    assert (environment / "install.log").read_text().endswith("Collecting torch\nInstalling\n")


def test_every_version_is_constrained(environment: Path) -> None:
    install(environment, "10", ".[test]")

    assert f"-c {ROOT / 'constraints.txt'} -e .[test]" in arguments_of_pip(environment)


def test_a_failure_shows_the_end_of_the_output(environment: Path) -> None:
    prints = "\n".join(f"line {number}" for number in range(100)) + "\nERROR: no such version"
    ended = install(environment, "10", "torch==9", prints=prints, status=1)

    assert ended.returncode == 1
    assert "ERROR: no such version" in ended.stdout
    assert "line 99" in ended.stdout
    assert "line 9\n" not in ended.stdout
    assert f"the whole output of pip is in {environment / 'install.log'}" in ended.stdout


def test_a_failure_that_is_expected_prints_one_line(environment: Path) -> None:
    ended = install(environment, "10", "torch==9", "--otherwise", "The next.", status=1)

    assert (ended.returncode, ended.stdout) == (0, "  The next.\n")


def test_the_progress_line_says_what_happens_and_what_is_left() -> None:
    code = f"""
import runpy, sys
sys.stdout.isatty = lambda: True
module = runpy.run_path({str(INSTALL)!r})
module["Progress"].show.__globals__["free_megabytes"] = lambda: 0.0
progress = module["Progress"](100.0)
progress.read("Collecting torch==2.13.0 (from curate)")
progress.read("  Downloading torch-2.13.0-cp311.whl (14.0 MB)")
progress.show()
progress.read("Processing /wheels/scipy-1.17.1-cp311-cp311.whl (from curate)")
progress.show()
progress.read("Installing collected packages: a, b, c")
progress.show()
"""
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split("\n")  # text mode reads a carriage return as a new line

    assert re.match(r"  fetching torch, 0 of about 100 MB, \d+ s, about \d+ s left", shown[1])
    assert shown[2].startswith("  fetching scipy, ")
    assert shown[3].startswith("  installing 3 packages, ")
    assert {len(line) for line in shown[1:]} == {79}
