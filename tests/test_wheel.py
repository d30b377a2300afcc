"""The wheel, installed into a clean environment outside the checkout."""

import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from email.parser import HeaderParser
from pathlib import Path

import pytest
from support.paths import ROOT

import curate

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the wheel of this checkout, built as `make wheel` does."""
    folder = tmp_path_factory.mktemp("dist")
    pip = (sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation")
    subprocess.run([*pip, "--wheel-dir", folder, ROOT], check=True)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the bin folder of an environment with the wheel.

    A `.pth` file adds the dependencies of this environment to the path. The `.pth` files of this
    environment are not processed, so the checkout is not found through them.
    """
    home = tmp_path_factory.mktemp("clean") / "venv"
    venv.create(home, with_pip=False, symlinks=True)
    scripts = home / "bin"
    pip = (sys.executable, "-m", "pip", "--python", scripts / "python", "install", "-q")
    subprocess.run([*pip, "--no-deps", "--no-index", wheel], check=True)
    variables = {"base": str(home), "platbase": str(home)}
    own = Path(sysconfig.get_path("purelib", "venv", vars=variables))
    (own / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return scripts


def run(folder: Path, *command: object) -> str:
    """Return the output of a command in an activated environment, without PYTHONPATH."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    environment["PATH"] = f"{Path(str(command[0])).parent}{os.pathsep}{environment['PATH']}"
    ended = subprocess.run(
        [str(word) for word in command],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def test_the_wheel_contains_the_program_and_its_licence(wheel: Path) -> None:
    """Every file of the three packages, and nothing of tests or docs."""
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (metadata,) = (name for name in names if name.endswith("/METADATA"))
        card = HeaderParser().parsestr(archive.read(metadata).decode())
    assert (card["Version"], card["License-Expression"]) == (curate.__version__, "Apache-2.0")
    assert any(name.endswith("/licenses/LICENSE") for name in names)
    sources = [path for name in ("curate", "db", "pipelines") for path in (ROOT / name).rglob("*")]
    expected = {
        str(path.relative_to(ROOT))
        for path in (*sources, ROOT / "curate_command.py")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {name for name in names if ".dist-info/" not in name} == expected


def test_the_modules_are_those_of_the_wheel(installed: Path, tmp_path: Path) -> None:
    """Not those of the checkout, and with the version of the wheel."""
    code = (
        "import importlib.metadata as m, curate, db, pipelines, curate_command\n"
        "print(m.version('curate-pseudo-labels'), curate.__version__)\n"
        "for each in (curate, db, pipelines, curate_command): print(each.__file__)"
    )
    versions, *files = run(tmp_path, installed / "python", "-c", code).splitlines()
    assert versions.split() == [curate.__version__] * 2
    assert all(Path(file).is_relative_to(installed.parent) for file in files), files


def test_the_demo_runs_outside_the_checkout(installed: Path, tmp_path: Path) -> None:
    """With its migrations, queries, templates and the model of the segmenter."""
    small = ("--frames", 12, "--val", 4, "--labeled", 0.25, "--steps", 20)
    assert run(tmp_path, installed / "curate", "--version").split()[-1] == curate.__version__
    printed = run(tmp_path, installed / "curate", "demo", "work", *small)
    assert "Evaluate the detectors" in printed
    query = ("query", "-w", "work", "--csv", "SELECT split, count(*) FROM frame GROUP BY split")
    splits = run(tmp_path, installed / "curate", *query).split()
    assert sorted(splits[1:]) == ["labeled,3", "unlabeled,9", "val,4"]
    assert "unlabeled" in run(
        tmp_path, installed / "curate", "query", "-w", "work", "--named", "splits"
    )
    assert "predict" in run(tmp_path, installed / "curate", "status", "-w", "work")


@pytest.mark.parametrize(
    "example",
    # The export of a segmenter needs torchvision or a model file.
    sorted(set((ROOT / "examples").glob("*.py")) - {ROOT / "examples" / "export_segmenter.py"}),
    ids=lambda path: path.name,
)
def test_an_example_runs_outside_the_checkout(
    installed: Path, tmp_path: Path, example: Path
) -> None:
    """As its reader runs it, in an empty folder."""
    run(tmp_path, installed / "python", example)
