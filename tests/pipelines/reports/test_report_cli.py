"""`curate report`: one self-contained file."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

from support.pipelines_cli import Curate

from curate.errors import ConfigError, WorkspaceError
from pipelines.workspace.workspace import Workspace


class Headings(HTMLParser):
    """The h2 headings of a page, and its links."""

    def __init__(self) -> None:
        super().__init__()
        self.found, self.links, self.inside = [], [], False

    def handle_starttag(self, tag, attrs) -> None:
        """Collect links."""
        self.inside = tag == "h2"
        self.links += [value for key, value in attrs if key in {"src", "href"}]

    def handle_data(self, data) -> None:
        """Collect headings."""
        if self.inside:
            self.found.append(data)
        self.inside = False


def read(path: Path) -> tuple[list[str], str]:
    """Return headings and text of a report, and check that it loads nothing."""
    text = path.read_text(encoding="utf-8")
    reader = Headings()
    reader.feed(text)
    assert all(link.startswith("data:image/jpeg;base64,") for link in reader.links)
    assert reader.links
    assert not re.search(r"https?://|url\(|@import|<script", text)
    assert len(text) < 5_000_000
    return reader.found, text


def test_a_report_shows_a_round_its_changes_and_its_audit(
    curate: Curate, workspace: Workspace
) -> None:
    """The first round has no changes; an audit adds the reliability curve."""
    root = workspace.root
    for number in (1, 2):
        for command in ("predict", "repredict", "score", "solve"):
            assert curate(command, "--round", number, "-w", root)[0] == 0
    code, out, err = curate("report", "--round", 1, "-w", root)
    assert (code, err) == (0, "")
    first = Path(out.removeprefix("report: ").strip())
    assert first == root / "reports" / "round-01-pspsl.html"
    headings, text = read(first)
    assert [heading.split()[0] for heading in headings] == [
        "The", "Losses,", "Labels", "High", "Low"
    ]  # fmt: skip
    assert "18 labels in 6 unlabeled frames" in text
    assert "λ" in text
    assert curate("solve", "--round", 2, "--policy", "uniform", "-w", root)[0] == 0
    assert curate("audit", "--round", 2, "--replicates", 10, "-w", root)[0] == 0
    second = Path(json.loads(curate("report", "--json", "-w", root)[1])["report"])
    headings, text = read(second)
    assert "Since round 1" in headings
    assert "Comparison with other policies" in headings
    assert text.count("(this page)") == 1
    assert "Reliability" in headings
    code, out, _ = curate("report", "--format", "png", "--json", "-w", root)
    assert code == 0
    charts = [Path(path) for path in json.loads(out)["charts"]]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in charts)
    assert {path.parent for path in charts} == {second.with_suffix("")}
    assert {"loss.png", "weight.png", "reliability-val-bev.png"} <= {path.name for path in charts}
    assert second.read_text(encoding="utf-8") == text


def test_an_unknown_chart_format_is_found_before_any_work(
    curate: Curate, workspace: Workspace
) -> None:
    """By all commands that draw charts."""
    for command in ("report", "audit"):
        code, out, err = curate(command, "--format", "gif", "-w", workspace.root)
        assert code == ConfigError.exit_code
        assert "--format gif: use svg, png, pdf" in err
        assert out == ""


def test_without_weights_the_error_says_what_to_do(curate: Curate, workspace: Workspace) -> None:
    assert curate("predict", "-w", workspace.root)[0] == 0
    code, _, err = curate("report", "-w", workspace.root)
    assert code == WorkspaceError.exit_code
    assert "curate solve --round 1 --policy pspsl" in err
