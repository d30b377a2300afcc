"""Commands of the user, such as a trainer or a detector, with values for their placeholders.

A command is split like in a shell (shlex), but no shell runs it: there are no pipes, variables or
globs. In its arguments {name} is replaced by a value. A value with spaces stays within its
argument. The values are also in the environment, as CURATE_NAME. The command runs in the current
folder, and ends with curate, whatever ends curate; see `supervisor`.
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


@dataclass(frozen=True)
class UserCommand:
    """A program with its arguments.

    Attributes:
        title: what it is, such as "train command", for messages.
        arguments: the program and its arguments, with placeholders.
    """

    title: str
    arguments: tuple[str, ...]

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
        return cls(title, tuple(arguments))

    @property
    def short(self) -> str:
        """The program and its first argument, for messages."""
        return shlex.join(self.arguments[:2])

    def placeholders(self) -> list[str]:
        """Return the names in braces, in order."""
        return [name for each in self.arguments for name in _PLACEHOLDER.findall(each)]

    def check_placeholders(self, known: Collection[str]) -> None:
        """Raise ConfigError if a name in braces is not known."""
        for name in self.placeholders():
            if name not in known:
                raise ConfigError(
                    f"{self.title}: unknown placeholder {{{name}}}{did_you_mean(name, known)}; it "
                    f"has {', '.join(f'{{{each}}}' for each in known)}"
                )

    def check_program(self) -> None:
        """Raise ConfigError if the program does not exist or cannot be executed."""
        program = self.arguments[0]
        if _PLACEHOLDER.search(program) or shutil.which(program):
            return
        exists = os.sep in program and Path(program).exists()
        reason = "it is not an executable file" if exists else "no such program"
        raise ConfigError(f"{self.title}: {program} cannot be started: {reason}")

    def filled(self, values: Mapping[str, str]) -> list[str]:
        """Return the arguments with each {name} replaced; braces with other names stay."""
        return [fill(each, values) for each in self.arguments]

    def run(
        self, values: Mapping[str, str], output: int | IO[bytes], timeout_s: float | None = None
    ) -> int | None:
        """Run the command; return its exit code, or minus the number of the signal that ended it.

        Args:
            values: values of the placeholders.
            output: file that gets standard output and standard error.
            timeout_s: seconds after which the command is ended; the result is None then.
        """
        environment = {f"CURATE_{name.upper()}": value for name, value in values.items()}
        with subprocess.Popen(  # noqa: S603 - the user's own command, without a shell
            [sys.executable, "-I", "-S", supervisor.__file__, *self.filled(values)],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=output,
            env=os.environ | environment,
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


def fill(text: str, values: Mapping[str, str]) -> str:
    """Return a text with each {name} replaced, in one pass; braces with other names stay."""
    return _PLACEHOLDER.sub(lambda match: values.get(match[1], match[0]), text)


def describe_end(code: int) -> str:
    """Return how a command ended, for a message."""
    if code >= 0:
        return f"exit code {code}"
    known = -code in {each.value for each in signal.Signals}
    return f"signal {-code}" + (f" ({signal.Signals(-code).name})" if known else "")
