"""External trainers: their arguments, the checks, and the teacher of the next round."""

import hashlib
import json
import shlex
import sys
from pathlib import Path

import pytest
from support.pipelines_cli import Curate
from support.rounds import run_stage, run_workspace

from curate.errors import ConfigError, TrainerFailed, WorkspaceError
from pipelines.engine.rounds import find_teacher
from pipelines.workspace.workspace import Workspace

TRAINER = """
import os, sqlite3, sys
labels, output, number = sys.argv[1:4]
assert os.environ["CURATE_LABELS"] == labels and os.environ["CURATE_OUTPUT"] == output
weights = sqlite3.connect(labels).execute("SELECT weight FROM weighted_labels").fetchall()
print(f"round {number}: {len(weights)} labels from", os.environ["CURATE_TEACHER"], flush=True)
# The toy detector takes it for a list of frames that it fails on.
open(output, "w").write(f"student-{number}")
"""


@pytest.fixture
def command(tmp_path: Path) -> str:
    """Return a trainer in a few lines of Python, in a folder with a space."""
    script = tmp_path / "my trainer" / "train.py"
    script.parent.mkdir()
    script.write_text(TRAINER)
    return f"{shlex.join([sys.executable, str(script)])} {{labels}} {{output}} {{round}}"


@pytest.fixture
def exported(workspace: Workspace) -> Workspace:
    """Return a workspace with an external detector after its first round and export."""
    run_workspace(workspace)
    return workspace


def python(code: str) -> str:
    """Return a command that runs Python code."""
    return shlex.join([sys.executable, "-c", code])


def checkpoints(workspace: Workspace) -> list[tuple]:
    """Return rounds, policies, paths and hashes."""
    with workspace.database.reading() as connection:
        query = "SELECT round, policy, path, sha256 FROM checkpoint ORDER BY round"
        return [tuple(row) for row in connection.exec_driver_sql(query)]


def test_the_student_of_a_command_is_the_next_teacher(
    curate: Curate, exported: Workspace, command: str
) -> None:
    """It gets the labels, and its file is stored with its hash."""
    code, out, err = curate("train-round", "--command", command, "-w", exported.root, "--json")
    assert code == 0, err
    assert json.loads(out)[0]["done"] == 1
    path = exported.root / "checkpoints" / "round-01-pspsl.txt"
    assert path.read_text() == "student-1"
    digest = hashlib.sha256(hashlib.sha256(b"student-1").digest()).hexdigest()
    assert checkpoints(exported)[1] == (1, "pspsl", "checkpoints/round-01-pspsl.txt", digest)
    assert find_teacher(exported, 2)[1].path == path
    code, _, err = curate("predict", "-w", exported.root)
    assert code == 0, err
    with exported.database.reading() as connection:
        query = "SELECT count(*) FROM prediction WHERE round = 2"
        assert connection.exec_driver_sql(query).scalar_one() == 18


def test_the_labels_of_a_round_can_be_exported_after_its_training(
    curate: Curate, exported: Workspace, command: str, tmp_path: Path
) -> None:
    """The export does not start the next round."""
    code, _, err = curate("train-round", "--command", command, "-w", exported.root)
    assert code == 0, err
    code, out, _ = curate("export", "-w", exported.root)
    assert (code, out.split()[:2]) == (0, ["round", "1"])
    path = tmp_path / "labels.csv"
    code, out, _ = curate("export", "--format", "csv", "--output", path, "-w", exported.root)
    assert (code, out) == (0, f"18 labels of round 1 in {path}\n")
    with exported.database.reading() as connection:
        assert connection.exec_driver_sql("SELECT number FROM round").scalars().all() == [1]
    code, _, err = curate("predict", "-w", exported.root)
    assert code == 0, err
    code, out, _ = curate("report", "-w", exported.root)
    assert (code, Path(out.split()[-1]).name) == (0, "round-01-pspsl.html")


def test_a_command_given_as_an_option_trains_later_rounds_too(
    curate: Curate, exported: Workspace, command: str
) -> None:
    """After its first training it is stored in curate.toml, so no other trainer replaces it."""
    path = exported.root / "curate.toml"
    path.write_text("# mine\n" + path.read_text())
    before = path.read_text()
    curate("train-round", "--command", python("raise SystemExit(1)"), "-w", exported.root)
    assert path.read_text() == before
    code, _, err = curate("train-round", "--command", command, "-w", exported.root)
    assert code == 0
    assert err.splitlines()[-1] == ("curate.toml: stored command in [train] for later rounds")
    assert path.read_text().startswith("# mine\n")
    configured = Workspace.open(exported.root)
    assert configured.config == exported.with_settings("train", command=command).config
    done = [(each.round, each.stage) for each in run_workspace(configured, 2) if each.done]
    assert (1, "train-round") not in done
    assert (2, "train-round") in done
    assert find_teacher(configured, 3)[1].path.read_text() == "student-2"


def test_a_student_that_is_not_the_next_teacher_can_use_any_command(
    curate: Curate, exported: Workspace, command: str
) -> None:
    """The student of another policy does not change curate.toml."""
    before = (exported.root / "curate.toml").read_text()
    for name in ("solve", "export"):
        assert curate(name, "--policy", "uniform", "-w", exported.root)[0] == 0
    code, _, err = curate(
        "train-round", "--policy", "uniform", "--command", command, "-w", exported.root
    )
    assert (code, "for later rounds" in err) == (0, False)
    assert (exported.root / "curate.toml").read_text() == before


def test_the_output_of_the_trainer_is_streamed(
    capfd: pytest.CaptureFixture, exported: Workspace, command: str
) -> None:
    """To standard error, so standard output stays JSON."""
    configured = exported.with_settings("train", command=command)
    run_stage(configured, "train-round", 1, "pspsl")
    output = capfd.readouterr()
    assert output.out == ""
    assert f"round 1: 18 labels from {exported.config.detector.path}" in output.err


def test_a_configured_command_trains_in_every_round(workspace: Workspace, command: str) -> None:
    """`curate run` then has several rounds with an external detector, and a second run has none."""
    configured = workspace.with_settings("train", command=command)
    reports = run_workspace(configured, 2)
    assert [report.round for report in reports if report.stage == "train-round"] == [1, 2]
    assert find_teacher(configured, 2)[1].path.read_text() == "student-1"
    assert find_teacher(configured, 3)[1].path.read_text() == "student-2"
    assert {report.done for report in run_workspace(configured, 2)} == {0}
    other = configured.with_settings("train", command=command + " again")
    again = [report.stage for report in run_workspace(other, 1) if report.done]
    assert again == ["train-round"]


def test_without_a_student_the_next_round_has_no_teacher(
    workspace: Workspace, command: str
) -> None:
    """The external detector is not used in a round that needs a student."""
    configured = workspace.with_settings("train", command=command)
    with pytest.raises(WorkspaceError, match="round 2 has no teacher yet; run `curate train-r"):
        find_teacher(configured, 2)
    assert find_teacher(workspace, 2)[1].path == workspace.config.detector.path


def test_labels_are_exported_in_the_requested_format(curate: Curate, exported: Workspace) -> None:
    """Beside the SQLite file."""
    code = (
        "import os, shutil; path = os.environ['CURATE_LABELS'];"
        "shutil.copy(path + '/ps_label_e0.pkl', os.environ['CURATE_OUTPUT'])"
    )
    ended, _, err = curate(
        "train-round", "--command", python(code), "--labels-format", "st3d", "-w", exported.root
    )
    assert ended == 0, err
    assert (exported.root / "exports" / "round-01-pspsl-st3d" / "ps_label_e0.pkl").is_file()


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("import sys; sys.exit(3)", "ended with exit code 3"),
        ("import os; os.kill(os.getpid(), 9)", "ended with signal 9"),
        ("pass", "was not written, although the trainer ended without an error"),
        ("import os; open(os.environ['CURATE_OUTPUT'], 'w')", "is empty, although"),
        ("import os; os.mkdir(os.environ['CURATE_OUTPUT'])", "is empty, although"),
    ],
)
def test_a_failing_trainer_gives_one_line_and_an_exit_code(
    curate: Curate, exported: Workspace, command: str, code: str, message: str
) -> None:
    """Nothing is registered, and an earlier student does not change."""
    curate("train-round", "--command", command, "--round", 1, "-w", exported.root)
    before = checkpoints(exported)
    ended, _, err = curate(
        "train-round", "--command", python(code), "--round", 1, "-w", exported.root
    )
    assert ended == TrainerFailed.exit_code
    assert message in err
    assert err.count("\n") == 1
    assert checkpoints(exported) == before
    assert (exported.root / "checkpoints" / "round-01-pspsl.txt").read_text() == "student-1"


def test_a_killed_training_resumes_from_its_file(curate: Curate, exported: Workspace) -> None:
    """The trainer finds its own file again; without a new file the training has failed."""
    code = (
        "import os, sys; path = os.environ['CURATE_OUTPUT']; done = os.path.exists(path);"
        "open(path, 'a').write('half '); sys.exit(0 if done else 1)"
    )
    arguments = ("train-round", "--command", python(code), "--round", 1, "-w", exported.root)
    assert curate(*arguments)[0] == TrainerFailed.exit_code
    idle = ("train-round", "--command", python("pass"), "--round", 1, "-w", exported.root)
    ended, _, err = curate(*idle)
    assert ended == TrainerFailed.exit_code
    assert "is left from an earlier run" in err
    assert curate(*arguments)[0] == 0
    assert (exported.root / "checkpoints" / "round-01-pspsl.txt").read_text() == "half half "


def test_labels_that_are_not_exported_are_rejected(
    curate: Curate, workspace: Workspace, command: str
) -> None:
    """Before the trainer starts; so are exports older than their weights."""
    run_workspace(workspace)
    (workspace.root / "exports" / "round-01-pspsl.sqlite").unlink()
    ended, _, err = curate("train-round", "--command", command, "-w", workspace.root)
    assert ended == WorkspaceError.exit_code
    assert "run `curate export --round 1`" in err


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("", "is empty; write a program"),
        ("python 'train.py", "fix its quotes"),
        ("no-such-program {labels}", "no-such-program cannot be started"),
    ],
)
def test_an_invalid_command_is_rejected(
    curate: Curate, exported: Workspace, command: str, message: str
) -> None:
    ended, _, err = curate("train-round", "--command", command, "-w", exported.root)
    assert ended == ConfigError.exit_code
    assert message in err
    assert err.count("\n") == 1
