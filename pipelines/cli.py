"""The command `curate`: its commands in groups, and errors as one line with their exit code."""

import logging
import os
import sys
from collections.abc import Callable
from typing import Annotated, Any, TextIO

import typer
from typer.core import TyperGroup

import curate
from curate.errors import CurateError
from curate.warnings_once import NOTES
from pipelines.commands.audit import audit
from pipelines.commands.augment import augment
from pipelines.commands.bench import bench, bench_cell
from pipelines.commands.calibrate import calibrate
from pipelines.commands.check import check
from pipelines.commands.demo import demo
from pipelines.commands.diff import diff
from pipelines.commands.doctor import doctor
from pipelines.commands.evaluate import evaluate
from pipelines.commands.explain import explain
from pipelines.commands.export import export
from pipelines.commands.export_model import export_model
from pipelines.commands.graph import graph
from pipelines.commands.init import init
from pipelines.commands.predict import predict
from pipelines.commands.pretrain import pretrain
from pipelines.commands.query import query
from pipelines.commands.report import report
from pipelines.commands.repredict import repredict
from pipelines.commands.review import group as review
from pipelines.commands.run import run
from pipelines.commands.score import score
from pipelines.commands.segment import segment
from pipelines.commands.serve import serve
from pipelines.commands.simulate import simulate
from pipelines.commands.solve import solve
from pipelines.commands.status import status
from pipelines.commands.train_round import train_round
from pipelines.commands.view import view

GROUPS: dict[str, tuple[Callable[..., None] | typer.Typer, ...]] = {
    "Set up": (simulate, demo, init, doctor, check, status, graph),
    "Stages": (
        pretrain,
        segment,
        predict,
        augment,
        repredict,
        score,
        calibrate,
        solve,
        export,
        train_round,
        run,
        export_model,
    ),
    "Look and ask": (query, explain, view, report, diff, serve, review),
    "Measure": (evaluate, audit, bench),
}
"""The commands under the headings of the help text."""


class GroupedCommands(TyperGroup):
    """A command group with help under headings, and with untruncated descriptions."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one section per heading."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            if command is not None and not command.hidden:
                heading = getattr(command, "rich_help_panel", None) or "Commands"
                description = command.get_short_help_str(limit=1000)
                sections.setdefault(heading, []).append((name, description))
        widest = max(len(name) for rows in sections.values() for name, _ in rows)
        for heading, rows in sections.items():
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(widest), text) for name, text in rows])


app = typer.Typer(
    name="curate",
    help="Turn a 3D detector's predictions on unlabeled LiDAR-camera frames into weighted labels.",
    cls=GroupedCommands,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _show_version(requested: bool) -> None:
    if requested:
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


for _heading, _commands in GROUPS.items():
    for _command in _commands:
        if isinstance(_command, typer.Typer):
            app.add_typer(_command, rich_help_panel=_heading, cls=GroupedCommands)
        else:
            app.command(rich_help_panel=_heading)(_command)
app.command(hidden=True)(bench_cell)
COMMANDS = tuple(
    getattr(command.callback, "__name__", "").replace("_", "-")
    for command in app.registered_commands
    if not command.hidden
) + tuple(
    f"{group.typer_instance.info.name} {command.name}"
    for group in app.registered_groups
    if group.typer_instance
    for command in group.typer_instance.registered_commands
)


class _CurrentStderr(logging.StreamHandler[TextIO]):
    """Logs to what is standard error at the time, so that a progress bar moves below a warning."""

    def __init__(self) -> None:
        logging.Handler.__init__(self)
        self.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))

    @property
    def stream(self) -> TextIO:  # type: ignore[override]
        """Return the stream, which rich replaces while it draws a bar."""
        return sys.stderr


def log_warnings() -> None:
    """Print warnings and notes to standard error, above a progress bar if there is one."""
    logging.basicConfig(level=logging.WARNING, handlers=[_CurrentStderr()])
    logging.getLogger(NOTES).setLevel(logging.INFO)


def main() -> None:
    """Run the command line; an error ends in one line on stderr and its own exit code."""
    # Idle threads of torch's pool sleep instead of spinning on the core of another process.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    log_warnings()
    try:
        app(prog_name="curate")
    except CurateError as error:
        # The message may quote a file with line breaks; it is printed as one line.
        sys.stderr.write(f"error: {' '.join(str(error).splitlines())}\n")
        sys.exit(error.exit_code)
    except BrokenPipeError:
        sys.exit(0)
    except OSError as error:
        # The system is at fault, not the input: a full disk or a read-only folder, for example.
        place = f"{error.filename}: " if error.filename else ""
        reason = error.strerror or error
        sys.stderr.write(f"error: {place}{reason}; fix it and rerun; finished work is kept\n")
        sys.exit(CurateError.exit_code)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; run the same command again to resume\n")
        sys.exit(130)
