"""The website of the pages: it builds without a warning, and loads nothing from elsewhere."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT

LOADED = re.compile(r"<(?:script|img|iframe|source)\b[^>]*\bsrc=\"?([^\"\s>]+)")
STYLES = re.compile(r"<link\b(?=[^>]*\brel=\"?(?:stylesheet|icon|preconnect|preload))[^>]*>")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The website; a warning, such as a page that is missing from the navigation, is an error."""
    pytest.importorskip("material", reason="the extra `docs` is not installed")
    folder = tmp_path_factory.mktemp("site")
    ended = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder],
        cwd=ROOT, capture_output=True, text=True, check=False,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    return folder


def test_every_page_is_built(site: Path) -> None:
    """Each Markdown file has its page."""
    for path in (ROOT / "docs").rglob("*.md"):
        name = path.relative_to(ROOT / "docs").with_suffix("")
        folder = name.parent if name.name in {"index", "README"} else name
        assert (site / folder / "index.html").is_file(), name


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    """Scripts, styles, fonts and images come with the site, and no page asks for mermaid."""
    pages = sorted(site.rglob("*.html"))
    assert pages
    for page in pages:
        text = page.read_text()
        links = [re.search(r"href=\"?([^\"\s>]+)", tag) for tag in STYLES.findall(text)]
        loaded = LOADED.findall(text) + [found[1] for found in links if found]
        assert [url for url in loaded if re.match(r"(?:https?:)?//", url)] == [], page
        # The theme's script would fetch mermaid from the network for such a block.
        assert 'class="mermaid"' not in text, page
