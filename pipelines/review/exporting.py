"""curate review export: a folder with boxes, pictures and a table, whole or not there."""

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
boxes asked about.

pictures/FRAME.png shows every frame with its numbered boxes; those asked about are marked "?".
{editor}
review.csv, column decision: accept or reject for a box; accept in the row `all` for every box of
the frame that you leave as it is.

A box that you leave unchanged without a word counts as not looked at, and so does a frame whose
file you take away. A box that you delete is rejected, one that you move, turn, resize or rename is
corrected, one that you draw is added.

Then: curate review import THIS_FOLDER --dry-run
"""
_EDITORS = {
    "kitti": "label_2/FRAME.txt holds them as KITTI label lines; line i is box i.\n",
    "labelcloud": (
        "Start `labelCloud` in this folder: it finds pointclouds/ and labels/ there, the labels in "
        "the\nformat centroid_abs.\n"
    ),
    "cvat": (
        "In CVAT make a task with labels.json (tab Raw) and task.zip, then upload annotations.zip "
        "into\nit as `Datumaro 3D 1.0`. When done, export in that format and put the file in place "
        "of\nannotations.zip, or name it: curate review import THIS_FOLDER --answer FILE.zip\n"
    ),
}


def write_review(
    workspace: Workspace, folder: Path, sheet: Sheet, editor: Editor, progress: Progress
) -> None:
    """Write the folder of a review and remembers it.

    Raises:
        ConfigError: if the folder holds something: it may be a review with answers in it.
        DataError: if a frame cannot be read.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(
            f"{folder}: is there already, and may hold answers; name a folder that is not there"
        )
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)  # of an export that was killed
    try:
        partial.mkdir(parents=True)
        _fill(workspace, partial, sheet, editor, progress)
        _remember(workspace, sheet)
        if folder.exists():
            folder.rmdir()
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def reviews(workspace: Workspace) -> Sequence[bulk.Row]:
    """The rows of `review`, the oldest first, each with its number of human labels by decision."""
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
    )  # fmt: skip
    (folder / "README.txt").write_text(text.replace("review.csv", TABLE), encoding="utf-8")


def _remember(workspace: Workspace, sheet: Sheet) -> None:
    """Store the review; one that was handed out before keeps its row."""
    table = bulk.table("review")
    now = datetime.now(UTC).isoformat(timespec="seconds")
    row = (sheet.id, sheet.round, sheet.policy, sheet.editor, len(sheet.frames), sheet.boxes,
           sheet.asked, now, None)  # fmt: skip
    with workspace.database.writing() as connection:
        same = table.select().where(table.c.id == sheet.id)
        if not bulk.select(connection, same):
            # `bulk` leaves surrogate keys named id to the database; this one is a hash.
            names = [column.name for column in table.columns]
            connection.execute(table.insert().values(dict(zip(names, row, strict=True))))
