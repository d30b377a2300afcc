"""curate doctor: check data, calibration and segmentation on one frame."""

from typing import Annotated, Optional

import typer

from pipelines.commands.options import JsonOption, WorkspaceOption, open_workspace
from pipelines.reports.terminal import print_json, print_line


def doctor(
    frame: Annotated[
        Optional[str],  # noqa: UP045
        typer.Argument(help="Frame id or number, e.g. 000008; default: the first unlabeled frame."),
    ] = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check one frame from file to box: data, calibration, segmentation, and box conventions.

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
        for finding in findings:
            print_line(f"{finding.state:<8} {finding.check:<12} {finding.message}", indent=22)
    if any(finding.state == "wrong" for finding in findings):
        raise typer.Exit(1)
