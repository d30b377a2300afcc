"""The command `curate`: its commands in groups, and errors as one line with their exit code."""

import logging
import os
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import curate
from curate.errors import CurateError
from pipelines.commands import (
    audit,
    bench,
    check,
    demo,
    diff,
    doctor,
    evaluate,
    explain,
    export,
    graph,
    init,
    predict,
    pretrain,
    query,
    report,
    repredict,
    review,
    run,
    score,
    serve,
    simulate,
    solve,
    status,
    train_round,
    view,
)

GROUPS = {
    "Set up": (simulate, demo, init, doctor, check, status, graph),
    "Stages": (pretrain, predict, repredict, score, solve, export, train_round, run),
    "Look and ask": (query, explain, view, report, diff, serve, review),
    "Measure": (evaluate, audit, bench),
}
"""The commands as the help shows them."""


class GroupedCommands(TyperGroup):
    """A group with help that lists its commands under headings, each with its whole sentence."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a section per heading."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            if command is not None and not command.hidden:
                heading = getattr(command, "rich_help_panel", None) or "Commands"
                words = command.get_short_help_str(limit=1000)
                sections.setdefault(heading, []).append((name, words))
        widest = max(len(name) for rows in sections.values() for name, _ in rows)
        for heading, rows in sections.items():
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(widest), words) for name, words in rows])


app = typer.Typer(
    name="curate",
    help="Turn a 3D detector's predictions on unlabeled LiDAR-camera frames into weighted labels.",
    cls=GroupedCommands,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"curate {curate.__version__}")
        raise typer.Exit


@app.callback()
def _curate(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Show the version and exit.", is_eager=True, callback=_show_version
        ),
    ] = False,
) -> None:
    """Take the options that come before a command."""


for _heading, _modules in GROUPS.items():
    for _module in _modules:
        _known = (len(app.registered_commands), len(app.registered_groups))
        _module.register(app)
        for _command in app.registered_commands[_known[0] :]:
            _command.rich_help_panel = _heading
        for _group in app.registered_groups[_known[1] :]:
            _group.rich_help_panel = _heading
            _group.cls = GroupedCommands
COMMANDS = tuple(
    command.name or getattr(command.callback, "__name__", "")
    for command in app.registered_commands
    if not command.hidden
) + tuple(
    f"{group.typer_instance.info.name} {command.name}"
    for group in app.registered_groups
    if group.typer_instance
    for command in group.typer_instance.registered_commands
)


def main() -> None:
    """Run the command line; a wrong input ends in one line and its own exit code."""
    # Idle threads of torch's pool sleep instead of spinning on the core of another process.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        app(prog_name="curate")
    except CurateError as error:
        # One line, whatever a foreign file has put into it.
        sys.stderr.write(f"error: {' '.join(str(error).splitlines())}\n")
        sys.exit(error.exit_code)
    except BrokenPipeError:
        sys.exit(0)
    except OSError as error:
        # The machine's fault, not the input's: a full disk, a folder that cannot be written.
        place = f"{error.filename}: " if error.filename else ""
        reason = error.strerror or error
        sys.stderr.write(f"error: {place}{reason}; fix it and rerun; finished work is kept\n")
        sys.exit(CurateError.exit_code)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; the same command resumes\n")
        sys.exit(130)
