"""The common queries about labels use an index, whatever the number of labels."""

from pathlib import Path

import pytest
from sqlalchemy import text
from support.label_queries import COUNTS, FRAME, FRAME_OF_ROUND, HEAVIEST, TRUSTED, solved
from support.labels_at_scale import filled_workspace

from db import weight_index
from pipelines.queries.named_queries import find_query
from pipelines.workspace.workspace import Workspace


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Return a workspace with two thousand weighted labels."""
    return solved(filled_workspace(tmp_path_factory.mktemp("filled"), frames=40))


def _plan(workspace: Workspace, question: str) -> list[tuple[int, str]]:
    """Return the steps of SQLite's plan, each with its parent step."""
    with workspace.database.reading() as connection:
        rows = connection.execute(text(f"EXPLAIN QUERY PLAN {question}"))
        return [(row[1], row[3]) for row in rows]


@pytest.mark.parametrize("question", [TRUSTED, HEAVIEST, FRAME, FRAME_OF_ROUND, COUNTS])
def test_no_table_is_scanned_completely(workspace: Workspace, question: str) -> None:
    """SQLite seeks in every table of frames, predictions, evidence and weights.

    Only human labels and rounds, which are never many, are scanned; no temporary index
    and no Bloom filter is built for the query.
    """
    steps = [step for _, step in _plan(workspace, question)]
    assert {step.split()[1] for step in steps if step.startswith("SCAN")} <= {"h", "m", "r"}, steps
    assert not [step for step in steps if "AUTOMATIC" in step or "BLOOM" in step], steps


@pytest.mark.parametrize("columns", ["*", "frame, k, weight"])
def test_the_heaviest_labels_are_read_by_their_index(workspace: Workspace, columns: str) -> None:
    """The weights of the policy are sorted by the index.

    Only human labels are sorted at run time.
    """
    plan = _plan(workspace, HEAVIEST.replace("*", columns) + " LIMIT 5")
    index = "ix_weight_v_pspsl (round=? AND v>?)"
    (part,) = [part for part, step in plan if step.startswith("SEARCH w") and index in step]
    assert [step for of, step in plan if of == part and "TEMP B-TREE" in step] == [], plan


def test_a_named_query_of_one_policy_uses_the_index(workspace: Workspace) -> None:
    """The filter on policy and round reaches the index of the weights."""
    sql = find_query("trusted-frames").filtered("pspsl", 1)
    steps = [step for _, step in _plan(workspace, sql)]
    assert any("ix_weight_v_pspsl (round=? AND v>?)" in step for step in steps), steps


def test_the_counts_equal_those_of_the_labels(workspace: Workspace) -> None:
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


def test_indices_dropped_for_a_large_load_are_restored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the rows are those of a small load."""
    workspace = solved(filled_workspace(tmp_path / "work", frames=10), rounds=4)
    query = text("SELECT * FROM weight ORDER BY frame_id, k")
    schema = text("SELECT name, sql FROM sqlite_master WHERE type = 'index' ORDER BY name")
    with workspace.database.reading() as connection:
        before = [connection.execute(each).all() for each in (query, schema)]
    monkeypatch.setattr(weight_index, "REBUILT_FROM", 1)
    solved(workspace, rounds=3)
    solved(workspace, rounds=4)
    with workspace.database.reading() as connection:
        assert [connection.execute(each).all() for each in (query, schema)] == before
