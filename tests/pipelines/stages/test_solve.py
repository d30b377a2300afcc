"""solve: the weights of a policy replace its earlier ones, and nothing else."""

from pathlib import Path

import pytest
from sqlalchemy import text
from support.label_queries import solved
from support.labels_at_scale import EACH, filled_workspace

from db import bulk
from pipelines.workspace.workspace import Workspace

FRAMES = 10


@pytest.fixture(params=[1, EACH - 1, EACH, 3 * EACH + 1, 50_000])
def workspace(
    tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Workspace:
    """Return ten frames of 50 labels, weighted by two policies, written in batches."""
    monkeypatch.setattr(bulk, "BLOCK_ROWS", request.param)
    workspace = solved(filled_workspace(tmp_path / "work", FRAMES))
    return solved(workspace, "uda")


def _rows(workspace: Workspace, policy: str) -> list[tuple]:
    query = text("SELECT * FROM weight WHERE policy = :policy ORDER BY round, frame_id, k")
    with workspace.database.reading() as connection:
        return [tuple(row) for row in connection.execute(query, {"policy": policy})]


@pytest.mark.parametrize(
    "left", [[], [1], [FRAMES], [2, 3, 7], list(range(1, FRAMES)), list(range(1, FRAMES + 1))]
)
def test_removed_frames_leave_no_weight(workspace: Workspace, left: list[int]) -> None:
    """At the start, in the middle or at the end; another policy keeps its weights."""
    first, others = _rows(workspace, "pspsl"), _rows(workspace, "uda")
    assert len(first) == len(others) == FRAMES * EACH
    solved(workspace, frames=left)
    found = _rows(workspace, "pspsl")
    assert [row[:3] for row in found] == [row[:3] for row in first if row[1] in left]
    solved(workspace)
    assert _rows(workspace, "pspsl") == first
    assert _rows(workspace, "uda") == others


def test_solving_again_at_another_age_gives_the_rows_of_a_first_solve(
    workspace: Workspace, tmp_path: Path
) -> None:
    """To the last bit, although rows are updated in place."""
    others = _rows(workspace, "uda")
    younger = _rows(workspace, "pspsl")
    solved(workspace, rounds=7)
    fresh = solved(filled_workspace(tmp_path / "anew", FRAMES), rounds=7)
    assert _rows(workspace, "pspsl") == _rows(fresh, "pspsl") != younger
    assert _rows(workspace, "uda") == others


@pytest.mark.parametrize("statement", [
    "DELETE FROM weight WHERE policy = 'pspsl' AND frame_id = 4 AND k = 17",
    "UPDATE weight SET k = 1000 WHERE policy = 'pspsl' AND frame_id = 4 AND k = 17",
    "INSERT INTO weight SELECT round, frame_id, 1000 + k, policy, 0, rho_det, v, v FROM weight",
])  # fmt: skip
def test_manually_changed_weights_are_replaced(workspace: Workspace, statement: str) -> None:
    """Missing or extra rows do not shift the values of others."""
    before = _rows(workspace, "pspsl")
    with workspace.database.writing(keys_known=True) as connection:
        connection.execute(text(statement))
    solved(workspace)
    assert _rows(workspace, "pspsl") == before
