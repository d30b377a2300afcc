"""Ten million labels: solved for another policy and age, then the common queries.

The figures of docs/scale.md. CURATE_PROOF_LABELS sets a smaller number of labels, CURATE_PROOF_URL
another database.
"""

import json
import os
import time
from pathlib import Path

import pytest
from sqlalchemy import text
from support.label_queries import COUNTS, FRAME, FRAME_OF_ROUND, HEAVIEST, TRUSTED, solved
from support.labels_at_scale import EACH, filled_workspace
from support.process_tree import peak

LABELS = int(os.environ.get("CURATE_PROOF_LABELS", "10_000_000"))
# Limits: 60 s for a solve and 50 ms for a first row; the measured times are printed, see
# docs/scale.md.


@pytest.mark.slow
def test_ten_million_labels(tmp_path: Path) -> None:
    """Every label has a weight of both policies, and every query a result."""
    url = os.environ.get("CURATE_PROOF_URL")
    workspace = filled_workspace(tmp_path / "work", LABELS // EACH, url)
    figures: dict[str, float] = {}
    for name, policy, rounds in (("first", "pspsl", 3), ("age", "pspsl", 4), ("policy", "uda", 4)):
        start = time.perf_counter()
        solved(workspace, policy, rounds)
        figures[f"solve, {name}"] = time.perf_counter() - start
    for query in (TRUSTED, HEAVIEST, FRAME, FRAME_OF_ROUND, COUNTS):
        with workspace.database.reading() as connection:
            streaming = connection.execution_options(stream_results=True)
            start = time.perf_counter()
            assert streaming.execute(text(query)).fetchone()
            figures[query] = time.perf_counter() - start
    memory = peak() / 1024
    print(json.dumps({"labels": LABELS, "peak MiB": memory, **figures}, indent=1))  # noqa: T201 - what it is for
    with workspace.database.reading() as connection:
        stored = connection.execute(text("SELECT policy, count(*) FROM weight GROUP BY policy"))
        assert dict(stored.all()) == {"pspsl": LABELS, "uda": LABELS}
