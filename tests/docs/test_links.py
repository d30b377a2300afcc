"""Links and anchors of the pages."""

import re
from pathlib import Path

import pytest
from support.paths import ROOT

PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, by the rule of the site and of code forges."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    plain = [re.sub(r"[`*]|\]\([^)]*\)|\[", "", title).strip() for title in HEADING.findall(text)]
    return {re.sub(r"\s", "-", re.sub(r"[^\w\s-]", "", title).lower()) for title in plain}


def broken_links(page: Path) -> list[str]:
    """Return the links of a page that lead to no file or to no heading."""
    broken = []
    for target in LINK.findall(CODE.sub("", page.read_text())):
        if re.match(r"https?://", target):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name) if name else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            broken.append(target)
    return broken


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_to_a_file_and_a_heading(page: Path) -> None:
    """A page that is renamed or a heading that is changed must not leave links behind."""
    assert broken_links(page) == []


def test_a_broken_link_is_found(tmp_path: Path) -> None:
    """The check rejects a missing file and a missing heading, and accepts code."""
    page = tmp_path / "page.md"
    page.write_text(
        "# One `code` title\n[a](#one-code-title) [b](#two)\n"
        "[c](gone.md) [d](page.md#one) `[e](f)`\n"
    )
    assert broken_links(page) == ["#two", "gone.md", "page.md#one"]


def test_the_site_lists_every_page() -> None:
    """The navigation of the site has each page once."""
    listed = re.findall(r"([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    pages = [page.relative_to(ROOT / "docs").as_posix() for page in PAGES if page.parent != ROOT]
    assert sorted(listed) == sorted(pages)
