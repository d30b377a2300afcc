"""The named query `counts` with decisions of people, on both databases."""

import json
from pathlib import Path

import pytest
from support.pipelines_cli import Curate
from support.stored_rows import rows

from pipelines.workspace.workspace import Workspace

ENGINES = ("sqlite", "postgresql")
Reviewed = tuple[Workspace, Path, str]


def queried(curate: Curate, workspace: Workspace, *options: object) -> list[dict]:
    """Return the rows of the query."""
    code, out, err = curate("query", "--named", "counts", "--json", *options, "-w", workspace.root)
    assert code == 0, err
    return json.loads(out)


def test_counts_agree_with_the_labels(curate: Curate, reviewed: Reviewed) -> None:
    """`counts` is fast because it does not count labels; it has the same numbers all the same."""
    workspace, _, _ = reviewed
    assert curate("solve", "--policy", "uniform", "-w", workspace.root)[0] == 0
    expected = rows(
        workspace,
        "SELECT round, policy, category, count(*), sum(CASE WHEN weight > 0 THEN 1 ELSE 0 END), "
        "sum(CASE WHEN weight > 0.5 THEN 1 ELSE 0 END), sum(weight), "
        "sum(CASE WHEN provenance = 'human' THEN 1 ELSE 0 END) FROM weighted_labels "
        "GROUP BY round, policy, category ORDER BY round, policy, category",
    )
    found = [tuple(row.values()) for row in queried(curate, workspace)]
    assert [row[:6] for row in found] == [tuple(row[:6]) for row in expected]
    assert [row[7] for row in found] == [row[7] for row in expected]
    assert [row[6] for row in found] == pytest.approx([row[6] for row in expected])
    assert sum(row[7] for row in found) == 8
    one = queried(curate, workspace, "--policy", "pspsl")
    assert [tuple(row.values()) for row in one] == [row for row in found if row[1] == "pspsl"]
    assert curate("report", "-w", workspace.root)[0] == 0
