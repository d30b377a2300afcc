"""The command `curate`: its commands, and errors as one line with their exit code."""

import logging
import os
import sys

import typer

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

app = typer.Typer(
    name="curate",
    help="Turns a 3D detector's guesses on unlabeled LiDAR-camera frames into weighted labels.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for command in (
    demo,
    simulate,
    init,
    doctor,
    pretrain,
    predict,
    repredict,
    score,
    solve,
    export,
    train_round,
    run,
    status,
    graph,
    query,
    explain,
    view,
    diff,
    report,
    review,
    serve,
    evaluate,
    audit,
    check,
    bench,
):
    command.register(app)
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
    """Runs the command line; a wrong input ends in one line and its own exit code."""
    # Idle threads of torch's pool sleep instead of spinning on the core of another process.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        app()
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
        sys.stderr.write(f"error: {place}{reason}; mend it and run the command again, it goes on\n")
        sys.exit(CurateError.exit_code)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; run the command again, it continues\n")
        sys.exit(130)
