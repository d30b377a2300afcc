"""Students that a trainer of the user's trains: any command, told where labels and output are.

The command is split like a shell would (shlex), but no shell runs it: no pipes, no variables, no
globbing. In its arguments {labels}, {output}, {teacher}, {round} and {policy} are replaced, each
within its argument, so that a space in a path does no harm; the same are in the environment as
CURATE_LABELS and so on. It runs in the current folder, and what it prints goes to standard error.
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
    """Run the configured command, checks what it has produced and moves it to `output`.

    The command writes to another place, where what a killed run has left stays for it to continue
    from; a former student in `output` is replaced only by a finished one.

    Raises:
        ConfigError: if the command cannot be taken apart or started.
        TrainerFailed: if it ended with an error, or without having written the output.
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
    """Return the arguments of a command with values in the place of {names}; other braces stay.

    Raises:
        ConfigError: if a quote is open, or there is no command.
    """
    try:
        arguments = shlex.split(command)
    except ValueError as error:
        raise ConfigError(f"train command `{command}`: {error}; mend its quotes") from None
    if not arguments:
        raise ConfigError("train command: is empty; name a program and its arguments")
    return [_filled(argument, values) for argument in arguments]


def _filled(argument: str, values: dict[str, str]) -> str:
    """One pass over the argument, so that a value that holds a {name} stays as it is."""
    head, brace, rest = argument.partition("{")
    name, end, tail = rest.partition("}")
    if not brace:
        return head
    if end and name in values:
        return head + values[name] + _filled(tail, values)
    return head + brace + _filled(rest, values)


def _labels(workspace: Workspace, job: RoundJob) -> Path:
    """Return the exported labels in the format that the trainer wants."""
    path = export.file(workspace, job.context, job.policy)
    name = workspace.config.train.labels_format
    if name == "sqlite":
        return path
    exporter = EXPORTERS.build(name, offered={}, options={})
    path = path.with_name(f"{path.stem}-{exporter.name}{exporter.suffix}")
    export.export_as(workspace, exporter, job.context.number, job.policy, path)
    return path


def _run(arguments: list[str], values: dict[str, str]) -> None:
    environment = {f"CURATE_{name.upper()}": value for name, value in values.items()}
    sys.stderr.flush()
    try:
        ended = subprocess.run(  # noqa: S603 - the user's own command, without a shell
            arguments, env=os.environ | environment, stdout=_STANDARD_ERROR, check=False
        )
    except OSError as error:
        raise ConfigError(
            f"train command: {arguments[0]} cannot be started: {error.strerror}"
        ) from None
    if ended.returncode:
        code = ended.returncode
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        raise TrainerFailed(
            f"the trainer {shlex.join(arguments[:2])} ended with {how}; its own output above says "
            "why; the same command runs it again"
        )


def _check(draft: Path, before: tuple[int, int] | None) -> None:
    """Raise TrainerFailed if the trainer has not written its output."""
    after = _state(draft)
    if after is None:
        fault = "was not written"
    elif after[1] == 0:
        fault = "is empty"
    elif after == before:
        fault = "is left from an earlier run and was not written again"
    else:
        return
    raise TrainerFailed(
        f"{draft}: {fault}, though the trainer ended well; let it write its checkpoint, a file or "
        "a folder as your detector reads it, to {output} or $CURATE_OUTPUT"
    )


def _state(path: Path) -> tuple[int, int] | None:
    """When the file, or the last one in the folder, was written, and how long they are.

    None where there is nothing.
    """
    if not path.exists():
        return None
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    found = [file.stat() for file in files]
    return max((each.st_mtime_ns for each in found), default=0), sum(each.st_size for each in found)


def _take_place(draft: Path, output: Path) -> None:
    """Move what was written to its place; unlike a file, a folder does not replace anything."""
    if output.is_dir():
        shutil.rmtree(output)
    elif draft.is_dir():
        output.unlink(missing_ok=True)
    draft.replace(output)
