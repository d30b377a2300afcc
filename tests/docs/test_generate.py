"""The generated pages agree with the code."""

from pathlib import Path

import pytest

from docs.generate import ROOT, references

PAGES = references()


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_generated_page_is_up_to_date(path: Path) -> None:
    """`make docs` writes it again."""
    assert path.read_text() == PAGES[path], "run `make docs`"


def test_the_readme_is_short() -> None:
    """Under 150 lines."""
    assert len((ROOT / "README.md").read_text().splitlines()) < 150
