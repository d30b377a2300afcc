"""Rows read from the tables behind `weighted_labels` are those of the view."""

from pathlib import Path

import pytest
from sqlalchemy import text
from support.pipelines_cli import Curate
from support.reviewed import advance, corrected, export_review, import_review, only_first

from curate.exporters.base import WEIGHTED_LABEL_COLUMNS
from pipelines.labels.stored_rows import StoredRows
from pipelines.workspace.workspace import Workspace


def rows_of_view(workspace: Workspace, policy: str = "pspsl") -> list[tuple]:
    """Return the rows of the view in the order of frame and k."""
    names = ", ".join(WEIGHTED_LABEL_COLUMNS)
    query = text(f"SELECT {names} FROM weighted_labels WHERE round = 1 AND policy = :policy")
    with workspace.database.reading() as connection:
        rows = [tuple(row) for row in connection.execute(query, {"policy": policy})]
    return sorted(rows, key=lambda row: row[1:3])


@pytest.fixture
def reviewed(curate: Curate, workspace: Workspace, tmp_path: Path) -> Workspace:
    """Return a workspace in which a person accepted, moved, added and rejected boxes of a frame."""
    advance(curate, workspace, 1)
    frame = export_review(curate, workspace, tmp_path / "review", *only_first(workspace))
    corrected(tmp_path / "review", frame)
    import_review(curate, workspace, tmp_path / "review")
    return workspace


@pytest.mark.parametrize("size", [1, 4, 100])
def test_the_rows_are_those_of_the_view(reviewed: Workspace, size: int) -> None:
    """With and without decisions of people, whatever the blocks and the order of the keys."""
    expected = rows_of_view(reviewed)
    assert {row[-3] for row in expected} == {"detector", "human"}
    with reviewed.database.reading() as connection:
        stored = StoredRows(connection, 1, "pspsl")
        blocks = list(stored.blocks(WEIGHTED_LABEL_COLUMNS, size=size))
        assert [row for block in blocks for row in block] == expected
        assert stored.frames() == sorted({row[1] for row in expected})
        assert StoredRows(connection, 1, "spsl").frames() == []


def test_frames_are_in_the_order_of_their_names(reviewed: Workspace) -> None:
    """Their keys may be in another order, if frames were added later."""
    with reviewed.database.writing() as connection:
        connection.execute(text("UPDATE frame SET frame = 'x' || (1000 - id)"))
    expected = rows_of_view(reviewed)
    with reviewed.database.reading() as connection:
        found = [
            row
            for block in StoredRows(connection, 1, "pspsl").blocks(WEIGHTED_LABEL_COLUMNS, size=3)
            for row in block
        ]
    assert found == expected
    assert len({row[1] for row in found}) == 6


def test_some_columns_of_some_frames(reviewed: Workspace) -> None:
    """Sorted by frame and k even if neither is requested."""
    expected = rows_of_view(reviewed)
    frames = sorted({row[1] for row in expected})[::2]
    place = WEIGHTED_LABEL_COLUMNS.index
    with reviewed.database.reading() as connection:
        stored = StoredRows(connection, 1, "pspsl")
        [block] = stored.blocks(("weight", "score"), frames)
    assert block == [
        (row[place("weight")], row[place("score")]) for row in expected if row[1] in frames
    ]
