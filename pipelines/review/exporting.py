"""curate review export: write a folder of boxes, images and a table, completely or not at all."""

import shutil
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from curate.errors import ConfigError
from curate.review.editors.base import Editor
from curate.review.pictures import draw_review
from curate.review.sheet import Sheet, write_sheet
from curate.review.table import TABLE, write_table
from curate.viewing.canvas import save_png
from db import bulk
from pipelines.engine.progress import Progress
from pipelines.workspace.workspace import Workspace

PICTURES = "pictures"
_HOW_TO = """Review {id}: round {round}, weights by {policy}, {frames} frames, {asked} of {boxes} \
boxes to review.

pictures/FRAME.png shows a frame; each box has its k, and the boxes to review are marked "?".
{editor}{proposals}
review.csv: write accept or reject into the column decision of a label k. accept in the row `all` of
a frame accepts all its boxes that you leave unchanged.

A box that you leave unchanged without a decision counts as not reviewed, and so do the boxes of a
frame if you delete its file. A box that you delete is rejected; one that you move, turn, resize or
rename is corrected; one that you draw is added.

Then run: curate review import THIS_FOLDER --dry-run
"""
_PROPOSALS = (
    "Boxes with k of 2000000 or more are proposals of `curate propose`: objects that may have been"
    "\nmissed. They have no score and no weight.\n"
)
_EDITORS = {
    "kitti": "label_2/FRAME.txt has the boxes as KITTI label lines, in the order of review.csv.\n",
    "labelcloud": (
        "Start `labelCloud` in this folder: it finds pointclouds/ and labels/ there. The labels "
        "have the\nformat centroid_abs.\n"
    ),
    "cvat": (
        "In CVAT create a task with labels.json (tab Raw) and task.zip, then upload annotations.zip"
        "\nto it as `Datumaro 3D 1.0`. When done, export in that format and replace annotations.zip"
        "\nwith the export, or specify it: curate review import THIS_FOLDER --answer FILE.zip\n"
    ),
}


def write_review(
    workspace: Workspace, folder: Path, sheet: Sheet, editor: Editor, progress: Progress
) -> None:
    """Write the folder of a review and store the review in the database.

    Raises:
        ConfigError: if the folder is not empty: it may contain an edited review.
        DataError: if a frame cannot be read.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder}: already exists and may contain edits; specify a new folder")
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)  # left by an export that was killed
    try:
        partial.mkdir(parents=True)
        _fill(workspace, partial, sheet, editor, progress)
        _store_review(workspace, sheet)
        if folder.exists():
            folder.rmdir()
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def reviews(workspace: Workspace) -> Sequence[bulk.Row]:
    """Return the rows of `review`, oldest first, with the number of human labels by decision."""
    review, label = bulk.table("review"), bulk.table("human_label")
    query = review.select().order_by(review.c.exported_at, review.c.id)
    with workspace.database.reading() as connection:
        rows = bulk.select(connection, query)
        decided = bulk.select(connection, label.select().with_only_columns(
            label.c.review, label.c.decision
        ))  # fmt: skip
    names = ("accepted", "rejected", "moved", "added")
    return [(*row, *(decided.count((row[0], name)) for name in names)) for row in rows]


def _fill(
    workspace: Workspace, folder: Path, sheet: Sheet, editor: Editor, progress: Progress
) -> None:
    editor.write(folder, sheet, lambda name: workspace.dataset.read(name, image=True))
    (folder / PICTURES).mkdir()
    with progress.track("pictures", len(sheet.frames)) as advance:
        for shown in sheet.frames:
            frame = workspace.dataset.read(shown.frame, image=True)
            title = f"frame {shown.frame}, round {sheet.round}, weights by {sheet.policy}"
            save_png(
                folder / PICTURES / f"{shown.frame}.png", draw_review(frame, shown, title=title)
            )
            advance(1, "")
    write_table(folder, sheet)
    write_sheet(folder, sheet)
    text = _HOW_TO.format(
        id=sheet.id, round=sheet.round, policy=sheet.policy, frames=len(sheet.frames),
        asked=sheet.asked, boxes=sheet.boxes, editor=_EDITORS.get(editor.name, ""),
        proposals=_PROPOSALS if any(b.is_proposal for f in sheet.frames for b in f.boxes) else "",
    )  # fmt: skip
    (folder / "README.txt").write_text(text.replace("review.csv", TABLE), encoding="utf-8")


def _store_review(workspace: Workspace, sheet: Sheet) -> None:
    """Store the review; one that was exported before keeps its row."""
    table = bulk.table("review")
    now = datetime.now(UTC).isoformat(timespec="seconds")
    row = (sheet.id, sheet.round, sheet.policy, sheet.editor, len(sheet.frames), sheet.boxes,
           sheet.asked, now, None)  # fmt: skip
    with workspace.database.writing() as connection:
        earlier = table.select().where(table.c.id == sheet.id)
        if not bulk.select(connection, earlier):
            # `bulk` leaves surrogate keys named id to the database; this one is a hash.
            names = [column.name for column in table.columns]
            connection.execute(table.insert().values(dict(zip(names, row, strict=True))))
