"""curate explain: show how the weight of a label was computed."""

from typing import Annotated

import typer

from pipelines.commands.options import (
    JsonOption,
    LastRoundOption,
    PolicyOption,
    WorkspaceOption,
    open_workspace,
)
from pipelines.reports.terminal import print_json, print_line


def explain(
    frame: Annotated[str, typer.Argument(help="Frame id, e.g. 000008, or its number.")],
    k: Annotated[int, typer.Argument(min=0, help="Number of the label in the frame, from 0.")],
    policy: PolicyOption = None,
    round_number: LastRoundOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show every number behind a label's weight, and the equations that use it.

    Example: curate explain 000008 0
    """
    from pipelines.labels.of_one_frame import find_frame
    from pipelines.reports.explanation import explain_label

    opened = open_workspace(workspace)
    frame = find_frame(opened, frame)
    found = explain_label(opened, frame, k, round_number, policy or opened.config.run.method)
    if as_json:
        print_json(found)
    else:
        for line in found.lines:
            print_line(line, indent=17)
