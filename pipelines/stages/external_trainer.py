"""Training of students by the user's own command (`train.command`).

The command is split like in a shell (shlex), but no shell runs it: there are no pipes, variables or
globs. In its arguments {labels}, {output}, {teacher}, {round} and {policy} are replaced by their
values. A value with spaces stays within its argument. The values are also in the environment, as
CURATE_LABELS and so on. The command runs in the current folder, and its output goes to standard
error.
"""

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

from curate.errors import ConfigError, TrainerFailed
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
        ConfigError: if the command cannot be parsed or started.
        TrainerFailed: if it ends with an error, or does not write its output.
    """
    draft = output.parent / "training" / output.name
    values = {
        "labels": str(_labels(workspace, job)),
        "output": str(draft),
        "teacher": str(job.context.teacher.path),
        "round": str(job.context.number),
        "policy": job.policy,
    }
    arguments = split_command(workspace.config.train.command or "", values)
    draft.parent.mkdir(parents=True, exist_ok=True)
    before = _state(draft)
    _run(arguments, values)
    _check(draft, before)
    _take_place(draft, output)


def split_command(command: str, values: dict[str, str]) -> list[str]:
    """Return the arguments of a command, with each {name} replaced by its value.

    Braces with other names stay as they are.

    Raises:
        ConfigError: if a quote is not closed, or the command is empty.
    """
    try:
        arguments = shlex.split(command)
    except ValueError as error:
        raise ConfigError(f"train command `{command}`: {error}; fix its quotes") from None
    if not arguments:
        raise ConfigError("train command: is empty; write a program and its arguments")
    return [_filled(argument, values) for argument in arguments]


def _filled(argument: str, values: dict[str, str]) -> str:
    """Replace {names} in one pass, so that a value which contains a {name} is not changed."""
    head, brace, rest = argument.partition("{")
    name, end, tail = rest.partition("}")
    if not brace:
        return head
    if end and name in values:
        return head + values[name] + _filled(tail, values)
    return head + brace + _filled(rest, values)


def _labels(workspace: Workspace, job: RoundJob) -> Path:
    """Return the path of the labels in the configured format; export them if it is not SQLite."""
    name = workspace.config.train.labels_format
    if name == "sqlite":
        return export.file(workspace, job.context, job.policy)
    exporter = EXPORTERS.build(name, offered={}, options={})
    path = export.default_path(workspace, job.context.number, job.policy, exporter)
    export.export_as(workspace, exporter, job.context.number, job.policy, path)
    return path


def _run(arguments: list[str], values: dict[str, str]) -> None:
    environment = {f"CURATE_{name.upper()}": value for name, value in values.items()}
    sys.stderr.flush()
    try:
        result = subprocess.run(  # noqa: S603 - the user's own command, without a shell
            arguments, env=os.environ | environment, stdout=_STANDARD_ERROR, check=False
        )
    except OSError as error:
        raise ConfigError(
            f"train command: {arguments[0]} cannot be started: {error.strerror}"
        ) from None
    if result.returncode:
        code = result.returncode
        reason = f"signal {-code}" if code < 0 else f"exit code {code}"
        raise TrainerFailed(
            f"the trainer {shlex.join(arguments[:2])} ended with {reason}; see its output above, "
            "fix the cause and rerun the command"
        )


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
