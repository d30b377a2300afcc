"""The help of `curate`, and its start time."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT, TESTS
from support.pipelines_cli import Curate
from typer.main import get_command

import curate as package
from pipelines import registry
from pipelines.cli import COMMANDS, GROUPS, app
from pipelines.workspace.workspace import Workspace

# Not needed by commands that only read rows.
HEAVY = {
    "torch", "numba", "scipy", "open3d", "cv2", "onnx", "onnxruntime", "alembic", "sklearn",
    "matplotlib", "pandas", "safetensors", "sqlalchemy.dialects.postgresql",
}  # fmt: skip


def loaded(*arguments: object) -> set[str]:
    """Return the modules that are loaded once a command has ended, in a new process."""
    code = (
        f"import sys; sys.argv = {['curate', *map(str, arguments)]!r}\n"
        "from pipelines.cli import main\n"
        "code = None\n"
        "try: main()\n"
        "except SystemExit as end: code = end.code\n"
        "assert not code, code\n"
        "print('loaded:', *sys.modules)"
    )
    return set(printed(code).rpartition("loaded:")[2].split())


def printed(code: str) -> str:
    """What Python prints, in a process of its own."""
    ended = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, TESTS)))},
    )
    return ended.stdout


@pytest.mark.parametrize("command", ["--help", "init --help", "solve --help", "--version"])
def test_help_imports_neither_numpy_nor_the_database(command: str) -> None:
    """Nor the configuration."""
    found = loaded(*command.split())
    assert "typer" in found
    assert not found & (HEAVY | {"numpy", "sqlalchemy"})


def test_reading_rows_needs_no_heavy_imports(workspace: Workspace) -> None:
    """Neither status nor query imports what computes, though the workspace has all stages."""
    for command in (("status",), ("status", "--json"), ("query", "SELECT frame FROM frame")):
        found = loaded(*command, "-w", workspace.root)
        assert "sqlalchemy" in found
        assert not found & HEAVY, command


def test_a_command_rarely_looks_for_garbage(workspace: Workspace) -> None:
    """Python's own setting makes over a hundred collections of a status, and one more at exit."""
    code = (
        "import atexit, gc, sys\n"
        "collections = []\n"
        "gc.callbacks.append(lambda phase, _: collections.append(phase))\n"
        "atexit.register(lambda: print('counts:', len(collections) // 2, gc.get_freeze_count()))\n"
        f"sys.argv = ['curate', 'status', '-w', {str(workspace.root)!r}]\n"
        "import curate_command\n"
        "curate_command.main()"
    )
    collections, frozen = map(int, printed(code).rpartition("counts:")[2].split())
    assert collections < 50
    assert frozen > 10_000


def test_the_help_lists_every_command_under_a_heading_with_a_whole_sentence(
    curate: Curate, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the order of the groups, without an ellipsis, and within 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = curate("--help")
    assert code == 0
    assert "..." not in out.partition("\n")[2]
    assert max(map(len, out.splitlines())) <= 80
    assert re.findall(r"^([A-Z][a-z ]+):$", out, re.MULTILINE) == ["Options", *GROUPS]
    names = re.findall(r"^  ([a-z][a-z-]*)  +[A-Z]", out, re.MULTILINE)
    assert names == list(dict.fromkeys(names))
    assert set(names) == {name.partition(" ")[0] for name in COMMANDS}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_described_in_a_sentence(name: str) -> None:
    """The description starts with a capital letter or a name, and ends with a full stop."""
    command = get_command(app)
    for word in name.split():
        command = command.commands[word]
    first, *rest = command.help.split("\n\n")
    assert first.endswith(".")
    assert f"Example: curate {name}" in " ".join(" ".join(rest).split())
    for parameter in command.params:
        assert parameter.help, parameter.name
        assert parameter.help.endswith("."), parameter.name


@pytest.mark.parametrize(
    ("command", "names"),
    [
        ("init", registry.DATASETS),
        ("init", registry.DETECTORS),
        ("init", registry.SEGMENTERS),
        ("solve", registry.POLICIES),
        ("run", registry.POLICIES),
        ("score", registry.PRIORS),
        ("predict", registry.EXECUTORS),
        ("export", registry.EXPORTERS),
        ("train-round", registry.EXPORTERS),
        ("review export", registry.EDITORS),
    ],
)
def test_a_help_text_lists_the_registered_names(
    curate: Curate, command: str, names: registry.Registry
) -> None:
    """All names, in the order of the registry, and a user-supplied class."""
    _, out, _ = curate(*command.split(), "-h")
    text = " ".join(out.split()).replace("kitti- ", "kitti-")  # a line may end after a hyphen
    *others, last = (*names.classes, "module:Class")
    listed = f"{', '.join(others)}"
    assert listed in text
    assert last in text[text.index(listed) :]


@pytest.mark.parametrize("option", ["-h", "--help"])
@pytest.mark.parametrize("name", ["", *COMMANDS, "review"])
def test_both_options_show_the_help(curate: Curate, name: str, option: str) -> None:
    """Of every command and group."""
    code, out, _ = curate(*name.split(), option)
    assert code == 0
    assert out.startswith(f"Usage: curate {name}".rstrip())
    assert "-h, --help" in out


def test_the_version_is_that_of_the_package(curate: Curate) -> None:
    assert curate("--version") == (0, f"curate {package.__version__}\n", "")


@pytest.mark.parametrize(
    ("words", "expected"),
    [("curate exp", {"export", "explain"}), ("curate solve --policy spsl", {"spsl"})],
)
def test_the_shell_completes_commands_and_registered_names(words: str, expected: set[str]) -> None:
    """With the protocol that bash uses."""
    ended = subprocess.run(
        [sys.executable, "-m", "curate_command"],
        env=os.environ
        | {
            "_CURATE_COMPLETE": "complete_bash",
            "COMP_WORDS": words,
            "COMP_CWORD": str(len(words.split()) - 1),
        },
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    found = {line for line in ended.stdout.split() if line in expected}
    assert found == expected, ended.stderr


def test_python_runs_the_package_beside_packages_of_the_same_name(
    tmp_path: Path, workspace: Workspace
) -> None:
    """`python -m curate`, in a folder with packages `db` and `pipelines` of another project."""
    for name in ("db", "pipelines"):
        (tmp_path / "project" / name).mkdir(parents=True)
        (tmp_path / "project" / name / "__init__.py").write_text("raise RuntimeError('a stranger')")
    for arguments in (("--version",), ("status", "-w", str(workspace.root))):
        ended = subprocess.run(
            [sys.executable, "-m", "curate", *arguments],
            cwd=tmp_path / "project",
            env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (TESTS, ROOT)))},
            capture_output=True,
            text=True,
            check=False,
        )
        assert (ended.returncode, ended.stderr) == (0, "")
        assert ended.stdout
