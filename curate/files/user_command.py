"""Commands of the user, such as a trainer or a detector, with values for their placeholders.

A command is split like in a shell (shlex), but no shell runs it: there are no pipes, variables or
globs. In its arguments {name} is replaced by a value. A value with spaces stays within its
argument. The values are also in the environment, as CURATE_NAME. The command runs in a given
folder, that of the workspace, and ends with curate, whatever ends curate; see `supervisor`.
"""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from curate.errors import ConfigError
from curate.files import supervisor
from curate.spelling import did_you_mean

_PLACEHOLDER = re.compile(r"\{([A-Za-z_]\w*)\}")

# Text that a shell would not interpret, or that another shell gets: sh -c "$0 && b".
_LITERAL = re.compile(r"""'[^']*'|\\.|(?<!\S)-\w*c\s+"(?:\\.|[^"\\])*\"""")
_DOUBLE_QUOTED = re.compile(r'"(?:\\.|[^"\\])*"')
_VARIABLE = re.compile(r"\$(?:\w+|\{\w+[^}]*\}|\()|`|(?<![^\s:])~(?=[/\s]|\Z)|\A\s*\w+=\S*")
_OPERATOR = re.compile(r"(?<!\S)(?:&&|\|\|?|&|;|\d?>+(?:&\d|[^\s&]*)|&>\S*|<\S*)(?!\S)|;(?!\S)")
# An interpreter that is followed by its script, perhaps after options without a value.
_INTERPRETER = re.compile(
    r"(?:python|pypy|perl|ruby|Rscript|julia|node|sh|bash|dash|ksh|zsh)[\d.]*"
)
_FLAG = re.compile(r"-[uISEsBbOqvxe]+")


@dataclass(frozen=True)
class UserCommand:
    """A program with its arguments.

    Attributes:
        title: what it is, such as "train command", for messages.
        arguments: the program and its arguments, with placeholders.
        text: the command as the user wrote it.
    """

    title: str
    arguments: tuple[str, ...]
    text: str = ""

    @classmethod
    def parse(cls, title: str, command: str) -> "UserCommand":
        """Return the command in a text.

        Raises:
            ConfigError: if a quote is not closed, or the command is empty.
        """
        try:
            arguments = shlex.split(command)
        except ValueError as error:
            raise ConfigError(f"{title} `{command}`: {error}; fix its quotes") from None
        if not arguments:
            raise ConfigError(f"{title}: is empty; write a program and its arguments")
        return cls(title, tuple(arguments), command)

    @property
    def short(self) -> str:
        """The program and its first argument, for messages."""
        return shlex.join(self.arguments[:2])

    def placeholders(self) -> list[str]:
        """Return the names in braces, in order."""
        return [name for each in self.arguments for name in placeholders(each)]

    def check_placeholders(self, known: Collection[str]) -> None:
        """Raise ConfigError if a name in braces is not known."""
        for name in self.placeholders():
            if name not in known:
                raise ConfigError(
                    f"{self.title}: unknown placeholder {{{name}}}{did_you_mean(name, known)}; it "
                    f"has {', '.join(f'{{{each}}}' for each in known)}"
                )

    def check(self, folder: Path) -> None:
        """Check that the command can be started in a folder, as far as that is known.

        Args:
            folder: the folder in which it runs; it need not exist yet.

        Raises:
            ConfigError: if it needs a shell, or its program or script does not exist.
        """
        self._check_shell_syntax()
        self.check_program(folder)
        self._check_script(folder)

    def _check_shell_syntax(self) -> None:
        """Raise ConfigError if the command has words that only a shell understands."""
        text = _LITERAL.sub("x", self.text)
        found = _OPERATOR.search(_DOUBLE_QUOTED.sub("x", text)) or _VARIABLE.search(text)
        if found:
            raise ConfigError(
                f"{self.title}: `{found[0].strip()}` is shell syntax, but no shell runs the "
                "command; write sh -c '...' around it, env NAME=VALUE before the program, and "
                "whole paths in place of ~ and variables"
            )

    def check_program(self, folder: Path = Path()) -> None:
        """Raise ConfigError if the program does not exist or cannot be executed.

        Args:
            folder: the folder in which the command runs.
        """
        program = self.arguments[0]
        path = path_from(folder, program) if os.sep in program else Path(program)
        if _PLACEHOLDER.search(program) or shutil.which(path):
            return
        if os.sep not in program:
            reason = "no such program"
        elif path.exists():
            reason = "it is not an executable file"
        else:
            reason = describe_missing(program, folder)
        raise ConfigError(f"{self.title}: {program} cannot be started: {reason}")

    def _check_script(self, folder: Path) -> None:
        """Raise ConfigError if the program is an interpreter, and its script does not exist."""
        program, *rest = self.arguments
        script = next((each for each in rest if not _FLAG.fullmatch(each)), "-")
        if script.startswith("-") or _PLACEHOLDER.search(script):
            return
        if _INTERPRETER.fullmatch(Path(program).name) and not path_from(folder, script).exists():
            raise ConfigError(f"{self.title}: {describe_missing(script, folder)}")

    def filled(self, values: Mapping[str, str]) -> list[str]:
        """Return the arguments with each {name} replaced; braces with other names stay."""
        return [fill(each, values) for each in self.arguments]

    def run(
        self,
        values: Mapping[str, str],
        output: int | IO[bytes],
        timeout_s: float | None = None,
        folder: Path | None = None,
    ) -> int | None:
        """Run the command; return its exit code, or minus the number of the signal that ended it.

        Args:
            values: values of the placeholders.
            output: file that gets standard output and standard error.
            timeout_s: seconds after which the command is ended; the result is None then.
            folder: folder in which it runs; None for the current one.
        """
        environment = {f"CURATE_{name.upper()}": value for name, value in values.items()}
        with subprocess.Popen(  # noqa: S603 - the user's own command, without a shell
            [sys.executable, "-I", "-S", supervisor.__file__, *self.filled(values)],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=output,
            env=os.environ | environment,
            cwd=folder,
            start_new_session=True,  # Ctrl-C reaches curate, which ends the command
        ) as process:
            try:
                return process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                return None
            finally:
                if process.stdin is not None:
                    with suppress(BrokenPipeError):
                        process.stdin.close()
                process.wait()


def placeholders(text: str) -> list[str]:
    """Return the names in braces in a text, in order."""
    return _PLACEHOLDER.findall(text)


def fill(text: str, values: Mapping[str, str]) -> str:
    """Return a text with each {name} replaced, in one pass; braces with other names stay."""
    return _PLACEHOLDER.sub(lambda match: values.get(match[1], match[0]), text)


def path_from(folder: Path, name: str) -> Path:
    """Return a path that starts at a folder; ".." also leads out of one that does not exist yet."""
    path = folder / name
    return path if folder.exists() else Path(os.path.normpath(path))


def describe_missing(name: str, folder: Path) -> str:
    """Return that a path from a folder does not exist, and that it does from the current one."""
    here = Path(name).absolute()
    hint = f"; paths are relative to the workspace, write {here}" if here.exists() else ""
    return f"{path_from(folder, name)}: no such file{hint}"


def describe_end(code: int) -> str:
    """Return how a command ended, for a message."""
    if code >= 0:
        return f"exit code {code}"
    known = -code in {each.value for each in signal.Signals}
    return f"signal {-code}" + (f" ({signal.Signals(-code).name})" if known else "")
