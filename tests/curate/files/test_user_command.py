"""Commands of the user: their arguments, their end, and what happens to them when curate ends."""

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from contracts.samples import assert_one_line

from curate.errors import ConfigError
from curate.files.user_command import UserCommand, describe_end

# Start a child, report the numbers of both, and wait; SIGTERM does not impress the child.
FAMILY = """
import os, signal, subprocess, sys, time
wait = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(600)"
child = subprocess.Popen([sys.executable, "-c", wait])
open(sys.argv[1] + ".part", "w").write(f"{os.getpid()} {child.pid}")
os.rename(sys.argv[1] + ".part", sys.argv[1])
time.sleep(600)
"""


def python(code: str, *arguments: str) -> UserCommand:
    """Return a command that runs Python code."""
    return UserCommand("a command", (sys.executable, "-c", code, *arguments))


def wait_for(condition: Callable[[], bool]) -> None:
    """Wait until something is true."""
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def is_gone(process: int) -> bool:
    """Return whether a process has ended; a zombie counts."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return True
    return state == "Z"


def test_the_command_is_not_run_by_a_shell() -> None:
    """Special characters stay text, and values stay within their argument."""
    command = UserCommand.parse("t", "t --in={labels} '{other}' $HOME && {round")
    assert command.filled({"labels": "/my data/{round}; rm -rf", "round": "1"}) == [
        "t", "--in=/my data/{round}; rm -rf", "{other}", "$HOME", "&&", "{round",
    ]  # fmt: skip


@pytest.mark.parametrize(("text", "reason"), [("", "is empty"), ("python 'a.py", "fix its quotes")])
def test_a_command_that_cannot_be_parsed_is_rejected(text: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        UserCommand.parse("train command", text)


def test_unknown_placeholders_are_reported_with_the_nearest_one() -> None:
    command = UserCommand.parse("c", "infer --in {clouds} --out {result} --size {1}")
    with pytest.raises(ConfigError, match=r"placeholder \{result\}; did you mean 'results'\?"):
        command.check_placeholders(("clouds", "results"))


def test_a_program_is_looked_for_before_it_is_needed(tmp_path: Path) -> None:
    text = tmp_path / "infer.sh"
    text.write_text("#!/bin/sh\n")
    UserCommand.parse("c", "sh infer.sh").check_program()
    UserCommand.parse("c", "{teacher}/infer").check_program()
    with pytest.raises(ConfigError, match="no-such-program cannot be started: no such program"):
        UserCommand.parse("c", "no-such-program {clouds}").check_program()
    with pytest.raises(ConfigError, match=r"infer\.sh cannot be started: it is not an executable"):
        UserCommand.parse("c", shlex.quote(str(text))).check_program()


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("cd det && python infer.py {clouds}", "&&"),
        ("python infer.py {clouds} | tee log", "|"),
        ("sh a.sh; sh b.sh", ";"),
        ("sh infer.sh {clouds} >log 2>&1", ">log"),
        ("sh infer.sh {clouds} &", "&"),
        ("sh infer.sh < input", "<"),
        ("~/det/infer {clouds}", "~"),
        ("docker run -v ~/data:/data infer", "~"),
        ("docker run -v $HOME/data:/data infer", "$HOME"),
        ('python "$HOME/infer.py"', "$HOME"),
        ("python ${HOME}/infer.py", "${HOME}"),
        ("infer $(cat list)", "$("),
        ("infer `cat list`", "`"),
        ("CUDA_VISIBLE_DEVICES=1 python infer.py", "CUDA_VISIBLE_DEVICES=1"),
    ],
)
def test_shell_syntax_is_reported_with_what_to_write(text: str, found: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        UserCommand.parse("train command", text).check(tmp_path)
    assert_one_line(caught.value)
    assert f"train command: `{found}` is shell syntax" in str(caught.value)
    assert "sh -c '...'" in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "sh -c 'cd x && infer $CURATE_DATA > log; true'",
        'sh -c "cd x && infer $CURATE_DATA | tee ~/log"',
        "env CUDA_VISIBLE_DEVICES=1 true --in={clouds} --size=3",
        "true '$HOME' 'a;b' '&&' \\$HOME file~ a&b 50% x->y --pattern=.*[.]bin$ **/a {a,b}",
    ],
)
def test_quoted_and_harmless_text_is_no_shell_syntax(text: str, tmp_path: Path) -> None:
    UserCommand.parse("c", text).check(tmp_path)


def test_relative_paths_start_at_the_folder_in_which_the_command_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A script that is only in the current folder is reported with its whole path."""
    here, home = tmp_path / "here", tmp_path / "home"
    for folder in (here, home / "bin"):
        folder.mkdir(parents=True)
    monkeypatch.chdir(here)
    (here / "infer.py").touch()
    (here / "infer").write_text("#!/bin/sh\n")
    (here / "infer").chmod(0o755)
    with pytest.raises(ConfigError) as caught:
        UserCommand.parse("c", "python3 -u infer.py {clouds}").check(home)
    assert str(caught.value) == (
        f"c: {home}/infer.py: no such file; paths are relative to the workspace, write "
        f"{here}/infer.py"
    )
    with pytest.raises(ConfigError, match=f"no such file; .*, write {here}/infer"):
        UserCommand.parse("c", "./infer {clouds}").check(home)
    with pytest.raises(ConfigError, match=r"sh: .*missing\.sh: no such file$"):
        UserCommand.parse("sh", "bash missing.sh").check(home)
    for command in ("python3 ../here/infer.py", "../here/infer", "sh -e ../here/infer"):
        UserCommand.parse("c", command).check(tmp_path / "not yet there")
    for unknown in ("python3 -m infer", "python3 -X dev infer.py", "sh -c infer", "python3"):
        UserCommand.parse("c", unknown).check(home)
    tool = home / "bin" / "tool.sh"
    tool.write_text("pwd; cat bin/tool.sh >/dev/null && echo read\n")
    tool.chmod(0o755)
    with (tmp_path / "log").open("wb") as output:
        for text in ("sh bin/tool.sh", f"sh {tool}"):
            command = UserCommand.parse("c", text)
            command.check(home)
            assert command.run({}, output, folder=home) == 0
    assert (tmp_path / "log").read_text().split() == [str(home), "read"] * 2


def test_output_environment_and_exit_code_are_those_of_the_command(tmp_path: Path) -> None:
    code = (
        "import os, sys; print(os.environ['CURATE_DATA'], sys.argv[1], flush=True);"
        "print('aside', file=sys.stderr); sys.exit(7)"
    )
    with (tmp_path / "log").open("wb") as output:
        assert python(code, "{data}").run({"data": "/a b"}, output) == 7
        assert python("import os; os.kill(os.getpid(), 11)").run({}, output) == -signal.SIGSEGV
        assert UserCommand("c", ("/no/such/program",)).run({}, output) == 1
    said = (tmp_path / "log").read_text().splitlines()
    missing = "/no/such/program cannot be started: No such file or directory"
    assert said == ["/a b /a b", "aside", missing]
    assert describe_end(3) == "exit code 3"
    assert describe_end(-signal.SIGSEGV) == "signal 11 (SIGSEGV)"
    assert describe_end(-250) == "signal 250"


def test_a_command_that_takes_too_long_ends_with_its_children(tmp_path: Path) -> None:
    """Its child ignores SIGTERM and is killed."""
    started = tmp_path / "started"
    with (tmp_path / "log").open("wb") as output:
        assert python(FAMILY, str(started)).run({}, output, 2.0) is None
    for process in started.read_text().split():
        wait_for(lambda process=process: is_gone(int(process)))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_command_ends_with_curate(tmp_path: Path, number: signal.Signals) -> None:
    """Also if curate is killed and can do nothing about it."""
    started = tmp_path / "started"
    code = (
        "import sys; from curate.files.user_command import UserCommand;"
        "UserCommand('c', tuple(sys.argv[1:])).run({}, 2)"
    )
    command = [sys.executable, "-c", code, *python(FAMILY, str(started)).arguments]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as curate:
        wait_for(started.exists)
        os.kill(curate.pid, number)
        for process in started.read_text().split():
            wait_for(lambda process=process: is_gone(int(process)))
