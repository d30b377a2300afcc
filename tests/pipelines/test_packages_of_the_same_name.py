"""A user's own packages `curate`, `db` and `pipelines`, which Python finds before ours."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from support.paths import ROOT, TESTS

from pipelines.workspace.workspace import Workspace

NAMES = ("curate", "db", "pipelines")
# An import of this package instead of ours fails at once.
FAILING_MODULE = "raise RuntimeError('the package of a stranger was imported')\n"
SCRIPT = Path(sys.executable).with_name("curate")
COMMANDS = {
    "script": [str(SCRIPT)],
    "launcher": [sys.executable, "-m", "curate_command"],
}
EXECUTORS = [
    "serial",
    "process",
    pytest.param(
        "ray",
        marks=pytest.mark.skipif(find_spec("ray") is None, reason="pip install '.[ray]'"),
    ),
]


def write_packages(folder: Path) -> None:
    """Write a package of each name that raises when it is imported."""
    for name in NAMES:
        (folder / name).mkdir(parents=True)
        (folder / name / "__init__.py").write_text(FAILING_MODULE)


def write_modules(folder: Path) -> None:
    """Write the same as single files."""
    folder.mkdir()
    for name in NAMES:
        (folder / f"{name}.py").write_text(FAILING_MODULE)


def write_bare_folders(folder: Path) -> None:
    """Write folders without __init__.py, which Python takes for namespace packages."""
    for name in NAMES:
        (folder / name).mkdir(parents=True)
        (folder / name / "models.py").write_text(FAILING_MODULE)


@pytest.fixture(params=[write_packages, write_modules, write_bare_folders])
def project(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Return a folder with packages of the same names."""
    request.param(tmp_path / "project")
    return tmp_path / "project"


@pytest.fixture(params=COMMANDS)
def command(request: pytest.FixtureRequest) -> list[str]:
    """Return how curate is started."""
    if request.param == "script" and not SCRIPT.exists():
        pytest.skip("curate is not installed here, it has no console script")
    return COMMANDS[request.param]


def curate(command: list[str], project: Path, *arguments: object) -> subprocess.CompletedProcess:
    """Run curate in the project's folder, with the project first on PYTHONPATH."""
    folders = os.pathsep.join(map(str, (project, TESTS, ROOT)))
    return subprocess.run(
        [*command, *map(str, arguments)],
        cwd=project,
        env=os.environ | {"PYTHONPATH": folders, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


def test_help_and_status_work_beside_packages_of_the_same_name(
    command: list[str], project: Path, workspace: Workspace
) -> None:
    """In the current folder and on PYTHONPATH, as packages, modules and bare folders."""
    for arguments in (("--help",), ("status", "-w", workspace.root)):
        ended = curate(command, project, *arguments)
        assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.parametrize("executor", EXECUTORS)
def test_a_stage_runs_beside_packages_of_the_same_name(
    command: list[str], project: Path, workspace: Workspace, executor: str
) -> None:
    """Two workers, each a new process that searches for its modules again."""
    configuration = workspace.root / "curate.toml"
    text = configuration.read_text()
    assert "\nexecutor = " in text
    lines = [
        f'executor = "{executor}"' if line.startswith("executor = ") else line
        for line in text.splitlines()
        if not line.startswith("workers = ")
    ]
    workers = [] if executor == "serial" else ["workers = 2"]
    at = lines.index(f'executor = "{executor}"')
    configuration.write_text("\n".join([*lines[:at], *workers, *lines[at:], ""]))
    # Each command starts new workers, which takes long; one stage is enough to show that they
    # start.
    for stage in ("predict", "repredict", "score") if executor == "serial" else ("predict",):
        ended = curate(command, project, stage, "-w", workspace.root)
        assert ended.returncode == 0, ended.stderr
        assert "Traceback" not in ended.stderr


DETECTOR = """
from curate.detections import Detections
from support.toys import ToyDetector
{line}
class Det(ToyDetector):
    def predict(self, frame):
        {late}
        return super().predict(frame)
"""


def run_with_detector(
    project: Path, workspace: Workspace, line: str, late: str = "pass"
) -> subprocess.CompletedProcess:
    """Predict with a detector of the project; its module runs `line`, its method `late`."""
    (project / "mydet.py").write_text(DETECTOR.format(line=line, late=late))
    configuration = workspace.root / "curate.toml"
    text = configuration.read_text()
    configuration.write_text(text.replace("support.toys:ToyDetector", "mydet:Det"))
    return curate(COMMANDS["launcher"], project, "predict", "-w", workspace.root)


def write_project_database(project: Path) -> None:
    """Write the package `db` of a project, with a function that only that project has."""
    (project / "db").mkdir(parents=True)
    (project / "db" / "__init__.py").write_text("def connect(): return 'the project'\n")
    (project / "db" / "models.py").write_text("class Sensor: ...\n")
    (project / "db" / "sensors.py").write_text("")


@pytest.mark.parametrize(
    ("line", "late"),
    [
        ("import db", "pass"),
        ("import db; db.connect()", "pass"),
        ("from db import connect", "pass"),
        ("from db.models import Sensor", "pass"),
        ("import db.sensors", "pass"),
        ("pass", "import db; db.connect()"),
    ],
)
def test_a_detector_that_imports_its_own_db_is_rejected(
    tmp_path: Path, workspace: Workspace, line: str, late: str
) -> None:
    """The one-line error contains both packages and what to do, before any frame."""
    project = tmp_path / "project"
    write_project_database(project)
    ended = run_with_detector(project, workspace, line, late)
    assert ended.returncode == 2
    assert len(ended.stderr.splitlines()) == 1
    assert "'mydet:Det'" in ended.stderr
    for expected in (project / "db" / "__init__.py", ROOT / "db"):
        assert f"({expected})" in ended.stderr
    assert "rename yours" in ended.stderr


def test_a_detector_that_does_not_import_its_own_db_works(
    tmp_path: Path, workspace: Workspace
) -> None:
    """The package beside it is ignored."""
    project = tmp_path / "project"
    write_project_database(project)
    ended = run_with_detector(project, workspace, "import json")
    assert (ended.returncode, ended.stderr) == (0, "")


def test_a_detector_in_the_current_folder_is_found_without_a_pythonpath(
    tmp_path: Path, workspace: Workspace
) -> None:
    """The console script does not put the current folder on Python's path."""
    if not SCRIPT.exists():
        pytest.skip("curate is not installed here, it has no console script")
    (tmp_path / "mydet.py").write_text("class Det:\n    def predict(self, frame): ...\n")
    configuration = workspace.root / "curate.toml"
    text = configuration.read_text()
    configuration.write_text(text.replace("support.toys:ToyDetector", "mydet:Det"))
    ended = subprocess.run(
        [SCRIPT, "predict", "-w", workspace.root],
        cwd=tmp_path,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert ended.returncode == 2
    # It was found: the error is about its constructor, or the segmenter that is not on the path.
    assert "No module named 'mydet'" not in ended.stderr


def test_a_package_that_was_imported_first_is_reported(tmp_path: Path) -> None:
    """By a script that starts the command line itself."""
    (tmp_path / "db.py").write_text("")
    ended = subprocess.run(
        [sys.executable, "-c", "import db; import curate_command"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join((str(tmp_path), str(ROOT)))},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert ended.returncode == 1
    assert len(ended.stderr.splitlines()) == 1
    assert "'db'" in ended.stderr
    assert str(tmp_path) in ended.stderr
