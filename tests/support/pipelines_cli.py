"""The command line inside the test process."""

import sys
from collections.abc import Callable
from typing import Any

import pytest
from typer.main import get_command

from pipelines.cli import COMMANDS, app, main

Curate = Callable[..., tuple[int, str, str]]


def in_process(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> Curate:
    """Return a function that runs `curate` and returns (exit code, stdout, stderr)."""

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["curate", *map(str, arguments)])
        capsys.readouterr()
        try:
            main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        else:
            code = 0
        output = capsys.readouterr()
        return code, output.out, output.err

    return run


def with_option(option: str) -> set[str]:
    """Return the commands that have an option."""
    root = get_command(app)
    found = set()
    for name in COMMANDS:
        command: Any = root
        for word in name.split():
            command = command.commands[word]
        if any(option in parameter.opts for parameter in command.params):
            found.add(name)
    return found
