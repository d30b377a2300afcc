"""curate diff: compare the labels of two rounds."""

from typing import Annotated

import typer

from pipelines.commands.options import JsonOption, PolicyOption, WorkspaceOption, open_workspace
from pipelines.reports.terminal import print_json, print_table


def diff(
    before: Annotated[int, typer.Argument(min=1, help="Number of the earlier round.")],
    after: Annotated[int, typer.Argument(min=1, help="Number of the later round.")],
    policy: PolicyOption = None,
    limit: Annotated[int, typer.Option(min=0, help="Number of changed labels to list.")] = 10,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare the labels of two rounds: gained, lost and moved ones, and changed weights.

    Labels are matched one to one by BEV IoU within a frame and category. A label moved if its boxes
    have an IoU below 0.7, and got heavier or lighter if its weight changed by 0.05 or more.

    Example: curate diff 1 2 --policy pspsl
    """
    from dataclasses import astuple

    from pipelines.reports.differences import COLUMNS, compare_rounds

    opened = open_workspace(workspace)
    found = compare_rounds(opened, (before, after), policy or opened.config.run.method, limit)
    if as_json:
        print_json(found)
        return
    title = f"round {before} to {after}, weights by {found.policy}"
    print_table(
        [name.replace("_", " ") for name in COLUMNS],
        [tuple(row.values()) for row in found.categories],
        title=title,
    )
    if found.labels:
        names = ("change", "frame", "category", "k", "k after", "IoU", "weight", "weight after")
        print_table(names, map(astuple, found.labels), title="labels with the largest changes")
