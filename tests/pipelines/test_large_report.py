"""A report of two million labels: a small page, made in bounded memory."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from large_workspace import large_workspace

ROOT = Path(__file__).parents[2]
# Runs the command as a person would, and tells its greatest memory in KiB.
MEASURED = (
    "import resource, sys\n"
    "from pipelines.cli import main\n"
    "try:\n    main()\n"
    "finally:\n"
    "    usage = resource.getrusage(resource.RUSAGE_SELF)\n"
    "    print('peak', usage.ru_maxrss, 'seconds', usage.ru_utime + usage.ru_stime)\n"
)


def report(root: Path, *arguments: str) -> tuple[Path, int]:
    """The page of `curate report`, and the memory that it took in MiB."""
    ended = subprocess.run(
        [sys.executable, "-c", MEASURED, "report", "-w", str(root), *arguments],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    print(ended.stdout)  # noqa: T201 - `pytest -s` shows the figures
    found = re.search(r"report: (.*)\npeak (\d+)", ended.stdout)
    return Path(found[1]), int(found[2]) // 1024


@pytest.mark.slow
def test_two_million_labels_make_a_small_page(tmp_path: Path) -> None:
    """The first of two rounds has 2 million labels, the second a quarter; both make a page."""
    workspace = large_workspace(tmp_path, (2_000_000, 500_000))
    page, first = report(workspace.root, "--round", "1")
    text = page.read_text(encoding="utf-8")
    assert "2,000,000 labels in 40,000 unlabeled frames" in text
    assert len(text) < 1_500_000
    assert first < 2000
    page, second = report(workspace.root)
    text = page.read_text(encoding="utf-8")
    assert "500,000 labels" in text
    assert "Since round 1" in text
    assert len(text) < 1_500_000
    assert second < 3000
