"""curate doctor: is the chain from the sensors to the labels sound?"""

from typing import Annotated, Optional

import typer

from pipelines.commands.options import JsonOption, WorkspaceOption, open_workspace
from pipelines.reports.terminal import print_json, print_line


def doctor(
    frame: Annotated[
        Optional[str],  # noqa: UP045
        typer.Argument(help="Frame id; default: the first unlabeled frame."),
    ] = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check one frame through the whole chain: data, calibration, boxes and their convention.

    The exit code is 1 where something is wrong. Nothing is stored. Take a frame with near objects.

    Example: curate doctor 000008
    """
    from pipelines.assessment.doctor import examine

    name, findings = examine(open_workspace(workspace), frame)
    if as_json:
        print_json({"frame": name, "findings": findings})
    else:
        typer.echo(f"frame {name}")
        for one in findings:
            print_line(f"{one.state:<8} {one.check:<12} {one.message}", indent=22)
    if any(one.state == "wrong" for one in findings):
        raise typer.Exit(1)


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(doctor)
