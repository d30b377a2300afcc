"""A report of two million labels: a small page, in bounded memory."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.large_workspace import large_workspace
from support.paths import ROOT

# Runs the command and prints its peak memory in KiB.
MEASURED = (
    "import time\n"
    "from pipelines.cli import main\n"
    "from support.process_tree import peak\n"
    "try:\n    main()\n"
    "finally:\n    print('peak', peak(), 'seconds', time.process_time())\n"
)


# The libraries take 200 of it; without streaming, 200,000 labels already took 300.
MOST_MIB = 700


def measured(*arguments: str) -> tuple[str, int]:
    """Return what a command prints, and its peak memory in MiB."""
    ended = subprocess.run(
        [sys.executable, "-c", MEASURED, *arguments],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    print(ended.stdout)  # noqa: T201 - `pytest -s` shows the figures
    printed, peak = re.fullmatch(r"(.*)\npeak (\d+) .*\n", ended.stdout, re.DOTALL).groups()
    return printed, int(peak) // 1024


def report(root: Path, *arguments: str) -> tuple[Path, int]:
    """Return the page of `curate report`, and the peak memory in MiB."""
    printed, peak = measured("report", "-w", str(root), *arguments)
    return Path(printed.removeprefix("report: ")), peak


@pytest.mark.slow
def test_two_million_labels_make_a_small_page(tmp_path: Path) -> None:
    """The first of two rounds has 2 million labels, the second a quarter."""
    n = int(os.environ.get("CURATE_PROOF_LABELS", "2_000_000"))
    workspace = large_workspace(tmp_path, (n, n // 4))
    page, first = report(workspace.root, "--round", "1")
    text = page.read_text(encoding="utf-8")
    assert f"{n:,} labels in {n // 50:,} unlabeled frames" in text
    assert len(text) < 1_500_000
    assert first < MOST_MIB
    page, second = report(workspace.root)
    text = page.read_text(encoding="utf-8")
    assert f"{n // 4:,} labels" in text
    assert "Since round 1" in text
    assert len(text) < 1_500_000
    assert second < MOST_MIB
    printed, compared = measured("diff", "1", "2", "--json", "-w", str(workspace.root))
    rows = {row["category"]: row for row in json.loads(printed)["categories"]}
    assert (rows["all"]["before"], rows["all"]["after"]) == (n, n // 4)
    assert rows["all"]["lost"] == n - rows["all"]["matched"]
    assert compared < MOST_MIB
