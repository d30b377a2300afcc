"""Training of students by the user's own command (`train.command`).

`curate.files.user_command` says how a command is split, filled and run. Its output goes to standard
error.
"""

import shutil
import sys
from pathlib import Path

from curate.errors import TrainerFailed
from curate.files.user_command import describe_end
from pipelines.assembly import trainer_command
from pipelines.engine.stage import RoundJob
from pipelines.registry import EXPORTERS
from pipelines.stages import export
from pipelines.workspace.workspace import Workspace

_STANDARD_ERROR = 2


def train_externally(workspace: Workspace, job: RoundJob, output: Path) -> None:
    """Run the configured command, check the checkpoint that it wrote, and move it to `output`.

    The command writes to another path, in the folder `training`. Files of a killed run stay there,
    so that the next run can resume from them. A former student at `output` is replaced only if the
    training succeeds.

    Raises:
        ConfigError: if the command cannot be parsed, or its program does not exist.
        TrainerFailed: if it ends with an error, or does not write its output.
    """
    draft = output.parent / "training" / output.name
    values = {
        "labels": str(_labels(workspace, job)),
        "output": str(draft),
        "teacher": str(job.context.teacher.path or ""),
        "round": str(job.context.number),
        "policy": job.policy,
    }
    command = trainer_command(workspace.config.train.command or "", workspace.root)
    draft.parent.mkdir(parents=True, exist_ok=True)
    before = _state(draft)
    sys.stderr.flush()
    if code := command.run(values, _STANDARD_ERROR, folder=workspace.root):
        raise TrainerFailed(
            f"the trainer {command.short} ended with {describe_end(code)}; see its output above, "
            "fix the cause and rerun the command"
        )
    _check(draft, before)
    _take_place(draft, output)


def _labels(workspace: Workspace, job: RoundJob) -> Path:
    """Return the path of the labels in the configured format; export them if it is not SQLite."""
    name = workspace.config.train.labels_format
    if name == "sqlite":
        return export.file(workspace, job.context, job.policy)
    exporter = EXPORTERS.build(name, offered={}, options={})
    path = export.default_path(workspace, job.context.number, job.policy, exporter)
    export.export_as(workspace, exporter, job.context.number, job.policy, path)
    return path


def _check(draft: Path, before: tuple[int, int] | None) -> None:
    """Raise TrainerFailed if the trainer has not written its output."""
    after = _state(draft)
    if after is None:
        problem = "was not written"
    elif after[1] == 0:
        problem = "is empty"
    elif after == before:
        problem = "is left from an earlier run and was not written again"
    else:
        return
    raise TrainerFailed(
        f"{draft}: {problem}, although the trainer ended without an error; it must write its "
        "checkpoint, a file or a folder that your detector reads, to {output} or $CURATE_OUTPUT"
    )


def _state(path: Path) -> tuple[int, int] | None:
    """Return the latest modification time (ns) and total size of a file or a folder's files.

    None if the path does not exist.
    """
    if not path.exists():
        return None
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    found = [file.stat() for file in files]
    return max((each.st_mtime_ns for each in found), default=0), sum(each.st_size for each in found)


def _take_place(draft: Path, output: Path) -> None:
    """Move the checkpoint to `output`; what a folder cannot replace is deleted first."""
    if output.is_dir():
        shutil.rmtree(output)
    elif draft.is_dir():
        output.unlink(missing_ok=True)
    draft.replace(output)
