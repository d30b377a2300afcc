"""The command line inside the test process."""

import sys
from collections.abc import Callable

import pytest

from pipelines.cli import main

Curate = Callable[..., tuple[int, str, str]]


def in_process(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> Curate:
    """A function that runs `curate`: exit code, standard output, standard error."""

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
