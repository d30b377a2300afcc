"""Wrong names in the configuration are found before any work, by every command that needs them."""

import subprocess
import sys
from pathlib import Path

import pytest
from sqlalchemy import text
from support.pipelines_cli import Curate

from curate.errors import ConfigError
from pipelines.workspace.workspace import Workspace

STAGES = ("predict", "repredict", "score", "solve", "export", "train-round", "run")


def edit(workspace: Workspace, *changes: tuple[str, str]) -> None:
    """Replace lines of `curate.toml`; each line must exist."""
    path = workspace.root / "curate.toml"
    content = path.read_text()
    for old, new in changes:
        assert old in content
        content = content.replace(old, new, 1)
    path.write_text(content)


def fails_before_any_work(curate: Curate, workspace: Workspace, *command: str) -> str:
    """Return the message of a command that must end with a configuration error."""
    code, out, err = curate(*command, "-w", workspace.root)
    assert (code, out, err.count("\n")) == (ConfigError.exit_code, "", 1), err
    with workspace.database.reading() as connection:
        for table in ("round", "task", "prediction"):
            query = text(f"SELECT count(*) FROM {table}")
            assert connection.execute(query).scalar_one() == 0, table
    return err


@pytest.mark.parametrize("command", STAGES)
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "support.toys:ToyDetector"', 'name = "pilars"', "detector.name: unknown detector"),
        ('executor = "auto"', 'executor = "proces"', "run.executor: unknown executor"),
        ('labels_format = "sqlite"', 'labels_format = "kiti"', "train.labels_format: unknown"),
        ('method = "pspsl"', 'method = "pspls"', "run.method: unknown policy"),
        ('kind = "kitti"', 'kind = "kitty"', "dataset.kind: unknown dataset"),
    ],
)
def test_a_misspelled_name_stops_every_stage(
    curate: Curate, workspace: Workspace, command: str, old: str, new: str, words: str
) -> None:
    """The error contains the file, the key and the most similar name."""
    edit(workspace, (old, new))
    err = fails_before_any_work(curate, workspace, command)
    assert f"{workspace.root / 'curate.toml'}: {words}" in err
    assert "; did you mean '" in err


UNUSABLE = [
    (
        ("predict", "repredict", "run"),
        ("support.toys:ToyDetector", "support.toys:ToyDetectr"),
        "cannot be imported: support.toys has no 'ToyDetectr'; did you mean 'ToyDetector'?",
    ),
    (
        ("predict", "repredict", "score", "run"),
        ('executor = "auto"', 'executor = "no_such_package:Executor"'),
        "run.executor: executor 'no_such_package:Executor' cannot be imported: No module named",
    ),
    (
        ("solve", "export", "train-round", "run"),
        ('method = "pspsl"', 'method = "support.toys:NoPolicy"'),
        "run.method: policy 'support.toys:NoPolicy' cannot be imported",
    ),
    (
        ("solve", "export", "train-round", "run"),
        (
            "options = {}\n\n[solve.learned]",
            "options = {pspsl = {self_pased = false}}\n\n[solve.learned]",
        ),
        "run.method: policy 'pspsl' has no option 'self_pased'; did you mean 'self_paced'?",
    ),
    (
        ("score", "run"),
        ("support.toys:ToySegmenter", "support.toys:NoSegmenter"),
        "error: segmenter.name: segmenter 'support.toys:NoSegmenter' cannot be imported",
    ),
    (
        ("score", "run"),
        ("prior_options = {}", "prior_options = {points = {thresolds = {}}}"),
        "run.priors: prior 'points' has no option 'thresolds'; did you mean 'thresholds'?",
    ),
]


@pytest.mark.parametrize(
    ("command", "change", "words"),
    [(command, change, words) for commands, change, words in UNUSABLE for command in commands],
)
def test_a_class_that_cannot_be_used_is_found_before_any_work(
    curate: Curate, workspace: Workspace, command: str, change: tuple[str, str], words: str
) -> None:
    """By each command that uses it."""
    edit(workspace, change)
    assert words in fails_before_any_work(curate, workspace, command)


def test_an_export_format_for_the_trainer_is_checked_before_any_work(
    curate: Curate, workspace: Workspace
) -> None:
    """Not after frames have been predicted and scored."""
    edit(
        workspace,
        ('# command = "python train.py {labels} {output}"', 'command = "./train.sh"'),
        ('labels_format = "sqlite"', 'labels_format = "support.toys:NoFormat"'),
    )
    for command in ("train-round", "run"):
        err = fails_before_any_work(curate, workspace, command)
        assert "train.labels_format: exporter 'support.toys:NoFormat' cannot be imported" in err


@pytest.mark.parametrize("command", ["predict", "run"])
def test_a_failing_detector_constructor_stops_the_first_stage(
    curate: Curate,
    workspace: Workspace,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
) -> None:
    """It is one error of the command, not one failed frame after the other."""
    (tmp_path / "failing_detector.py").write_text(
        "class Mine:\n"
        "    def __init__(self, path):\n        raise OSError('no licence')\n"
        "    def predict(self, frame): ...\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    edit(workspace, ("support.toys:ToyDetector", "failing_detector:Mine"))
    code, out, err = curate(command, "-w", workspace.root)
    assert (code, out) == (ConfigError.exit_code, "")
    assert "detector 'failing_detector:Mine' cannot be created: OSError: no licence" in err
    with workspace.database.reading() as connection:
        assert connection.execute(text("SELECT count(*) FROM task")).scalar_one() == 0


def test_an_option_of_the_command_line_is_checked_like_the_file(
    curate: Curate, workspace: Workspace
) -> None:
    """Executor and policy."""
    err = fails_before_any_work(curate, workspace, "predict", "--executor", "proces")
    assert "command line: run.executor: unknown executor 'proces'" in err
    assert "did you mean 'process'?" in err
    for command in ("solve", "export", "train-round"):
        err = fails_before_any_work(curate, workspace, command, "--policy", "threshhold")
        assert "--policy: unknown policy 'threshhold'" in err
        assert "did you mean 'threshold'?" in err


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("detector.options={pat=1}", "detector.name: detector 'pillars' has no option 'pat'"),
        ("run.executor=no_such_package:X", "run.executor: executor 'no_such_package:X' cannot be"),
        ("train.labels_format=no_such_package:X", "train.labels_format: exporter 'no_such_package"),
        ("run.method=no_such_package:X", "run.method: policy 'no_such_package:X' cannot be"),
        ("solve.options.pspsl.scoop=1", "policy 'pspsl' has no option 'scoop'; did you mean 'scop"),
        ("segmenter.name=no_such_package:X", "segmenter.name: segmenter 'no_such_package:X' cann"),
        (
            "detector.options.nms_iou=2",
            "option nms_iou = 2 should be less than or equal to 1",
        ),
        ("detector.options.threads=0", "option threads = 0 should be greater than or equal to 1"),
        ("run.executor_options.auto.workers=0.5", "option workers = 0.5 should be a valid integer"),
        (
            "solve.options.pspsl.scope=7",
            "option scope = 7 should be 'round', 'category' or",
        ),
        ("dataset.options.camera='left'", 'option camera = "left" should be a valid integer'),
        (
            "train.options.snapshot_second=9",
            "unknown setting 'snapshot_second'; did you mean",
        ),
        ("train.options.pastd=4", "unknown setting 'pastd'; did you mean 'pasted'?; it accepts"),
        ("train.options.pasted=4", "train.options.pasted: set train.pasted instead"),
        (
            "train.options.steps=40",
            "set train.pretrain_steps and train.round_steps instead",
        ),
        ("train.options.rotation_limit_rad=inf", "should be a finite number"),
        ("train.options.scale_range=[1.1,0.9]", "[1.1, 0.9] is not an ascending range above 0"),
        ("train.options.snapshot_seconds='9'", 'snapshot_seconds = "9" should be a valid number'),
        ("train.preset=kiti", "train.preset of detector 'pillars': unknown preset 'kiti'"),
    ],
)
def test_a_workspace_is_not_created_with_a_class_that_cannot_be_used(
    curate: Curate, tmp_path: Path, toy_kitti: Path, change: str, words: str
) -> None:
    """`curate init` checks all of them, without loading a model."""
    code, out, err = curate("init", tmp_path / "w", "--root", toy_kitti, "--set", change)
    assert (code, out, err.count("\n")) == (ConfigError.exit_code, "", 1)
    assert words in err
    assert not (tmp_path / "w").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            "{snapshot_second = 9.0}",
            "unknown setting 'snapshot_second'; did you mean",
        ),
        ("{scale_range = [0.9]}", "train.options.scale_range = [0.9] should have more entries"),
        ("{flip_probability = 2}", "train.options.flip_probability = 2 should be less than or"),
        ("{scale_range = [1.1, 0.9]}", "scale_range [1.1, 0.9] is not an ascending range above 0"),
    ],
)
def test_further_settings_of_the_trainer_are_checked_before_any_work(
    curate: Curate, workspace: Workspace, options: str, words: str
) -> None:
    """Also by --dry-run, before a training that is due only after hours."""
    edit(
        workspace,
        ("support.toys:ToyDetector", "pillars"),
        ("\npath = ", "\n# path = "),
        ("options = {}\n\n[run]", f"options = {options}\n\n[run]"),
    )
    for command in (
        ("pretrain",), ("pretrain", "--dry-run"), ("train-round", "--dry-run"), ("run",),
        ("run", "--dry-run"),
    ):  # fmt: skip
        assert words in fails_before_any_work(curate, workspace, *command)


def test_a_query_does_not_import_unneeded_classes(
    curate: Curate, workspace: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not the user's detector, policy or executor: those may be broken or slow."""
    (tmp_path / "slow_module.py").write_text("raise SystemExit('was imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    edit(
        workspace,
        ("support.toys:ToyDetector", "slow_module:Detector"),
        ('method = "pspsl"', 'method = "slow_module:Policy"'),
        ('executor = "auto"', 'executor = "slow_module:Executor"'),
        ('labels_format = "sqlite"', 'labels_format = "slow_module:Exporter"'),
    )
    code, out, err = curate("query", "SELECT count(*) AS n FROM frame", "-w", workspace.root)
    assert (code, err) == (0, "")
    assert "12" in out
    assert "slow_module" not in sys.modules


def test_status_does_not_import_models(
    curate: Curate, workspace: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither torch for a detector that curate trains, nor a user's executor or exporter."""
    (tmp_path / "heavy_module.py").write_text("raise SystemExit('was imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    edit(
        workspace,
        ("support.toys:ToyDetector", "pillars"),
        ('executor = "auto"', 'executor = "heavy_module:Executor"'),
        ('labels_format = "sqlite"', 'labels_format = "heavy_module:Exporter"'),
    )
    code = (
        "import sys\n"
        f"sys.argv = ['curate', 'status', '-w', {str(workspace.root)!r}]\n"
        "from pipelines.cli import main\n"
        "try: main()\n"
        "except SystemExit as end: assert not end.code, end.code\n"
        "print(sorted({'torch', 'onnxruntime', 'open3d', 'heavy_module'} & set(sys.modules)))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.splitlines()[-1] == "[]"
