"""curate doctor: is the chain from the sensors to the labels sound?"""

from typing import Annotated, Optional

import typer

from pipelines.commands.options import JsonOption, WorkspaceOption, open_workspace
from pipelines.reports.terminal import print_json, print_line


def doctor(
    frame: Annotated[
        Optional[str],  # noqa: UP045
        typer.Argument(help="Frame id, e.g. 000008; default: the first unlabeled frame."),
    ] = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check one frame from file to box: data, calibration, segmentation, and how boxes are defined.

    Choose a frame with objects near the vehicle. Nothing is stored. The exit code is 1 if a check
    fails.

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
