"""curate status: show the progress of the stages."""

from typing import Annotated

import typer

from pipelines.commands.options import JsonOption, WorkspaceOption, open_workspace
from pipelines.reports.terminal import print_json, print_line, print_table


def status(
    failed: Annotated[
        bool, typer.Option("--failed", help="List every failed frame with its error.")
    ] = False,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show which stages of each round are done, stale or waiting, and how many frames failed.

    The row `review` counts the frames that people decided about; it is there if there are any.

    Example: curate status --failed
    """
    from pipelines.reports.status import decisions, failed_frames, overview
    from pipelines.workspace.splits import SPLITS, count_frames

    opened = open_workspace(workspace)
    if failed:
        columns, rows = failed_frames(opened)
    else:
        columns, rows = overview(opened)
    if as_json:
        print_json([dict(zip(columns, row, strict=True)) for row in rows])
    elif failed:
        for number, stage, frame, split, error in rows:
            print_line(f"round {number}  {stage}  {frame} ({split}): {error}", indent=4)
        print_line(f"{len(rows)} failed")
    else:
        splits = count_frames({split: opened.frames(split) for split in SPLITS})
        counts = ", ".join(f"{count} {split}" for split, count in splits.items())
        print_table(columns, rows, title=f"{opened.root}: {counts} frames")
        for line in decisions(opened):
            print_line(line, indent=4)
