"""The common questions about labels find their rows by an index, whatever the number of labels."""

from pathlib import Path

import pytest
from label_questions import COUNTS, FRAME, FRAME_OF_ROUND, HEAVIEST, TRUSTED, solved
from labels_at_scale import filled_workspace
from sqlalchemy import text

from db import bulk
from pipelines.workspace import Workspace


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Two thousand weighed labels."""
    return solved(filled_workspace(tmp_path_factory.mktemp("filled"), frames=40))


@pytest.mark.parametrize("question", [TRUSTED, HEAVIEST, FRAME, FRAME_OF_ROUND, COUNTS])
def test_no_table_is_read_from_end_to_end(workspace: Workspace, question: str) -> None:
    """SQLite seeks in every table of predictions, evidence and weights.

    Where frames are few, it may ask a Bloom filter of them before it seeks one. Only what people
    decided, which is never much, is read as a whole.
    """
    with workspace.database.reading() as connection:
        plan = [row[3] for row in connection.execute(text(f"EXPLAIN QUERY PLAN {question}"))]
    scanned = {step.split()[1] for step in plan if step.startswith("SCAN")}
    assert scanned <= {"weighted_labels", "h", "t"}, plan


def test_counts_are_those_of_the_labels(workspace: Workspace) -> None:
    """Per policy and category."""
    counted = (
        "SELECT policy, category, count(*), sum(weight > 0), sum(weight > 0.5), sum(weight) "
        "FROM weighted_labels GROUP BY policy, category ORDER BY policy, category"
    )
    stored = "SELECT policy, category, labels, kept, trusted, weight FROM label_count ORDER BY 1, 2"
    with workspace.database.reading() as connection:
        expected = [tuple(row) for row in connection.execute(text(counted))]
        found = [tuple(row) for row in connection.execute(text(stored))]
    assert [row[:-1] for row in found] == [row[:-1] for row in expected]
    assert [row[-1] for row in found] == pytest.approx([row[-1] for row in expected])


def test_indices_that_were_left_out_of_a_large_load_are_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the rows are those of a small one."""
    workspace = solved(filled_workspace(tmp_path / "work", frames=10), rounds=4)
    query = text("SELECT * FROM weight ORDER BY frame_id, k")
    schema = text("SELECT name, sql FROM sqlite_master WHERE type = 'index' ORDER BY name")
    with workspace.database.reading() as connection:
        before = [connection.execute(each).all() for each in (query, schema)]
    monkeypatch.setattr(bulk, "_REBUILT_FROM", 1)
    solved(workspace, rounds=3)
    solved(workspace, rounds=4)
    with workspace.database.reading() as connection:
        assert [connection.execute(each).all() for each in (query, schema)] == before
