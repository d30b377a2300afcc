"""The paths on the handwritten pages."""

import re
from pathlib import Path

import pytest
from support.paths import ROOT

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
MENTIONED = re.compile(r"(?<![\w./-])(?:curate|db|pipelines|tests|docs|examples)/[\w./-]*")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_path_on_a_page_exists(page: Path) -> None:
    """Pages must follow when files move. `NAME` stands for a file of the reader."""
    found = MENTIONED.findall(page.read_text())
    mentioned = {path.rstrip(".").partition("NAME")[0] for path in found}
    assert [path for path in sorted(mentioned) if not (ROOT / path).exists()] == []
