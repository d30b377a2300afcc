"""The report and the served pages in a real browser without a network, wide and narrow."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.browser import WIDTHS, Viewer, chromium
from support.serving import Pages

from pipelines.reports.report import write_report
from pipelines.workspace.workspace import Workspace


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """One for all tests."""
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def report(weighted: Workspace) -> Path:
    """The report of the only round."""
    return write_report(weighted, None, None)[0]


@pytest.mark.parametrize("width", WIDTHS)
def test_the_report_is_seen_as_it_is_meant(browser: Any, report: Path, width: int) -> None:
    """Charts with bars, tables with rows, pictures that are pictures, nothing beside the window."""
    viewer = Viewer(browser, width)
    page = viewer.open(report.as_uri())
    assert viewer.faults == []
    assert viewer.undecoded() == []
    assert page.locator("img").count() >= 2
    assert page.locator("svg .bar").count() > 40
    assert page.locator("svg .mark").count() >= 1
    assert page.locator("tbody tr").count() >= 3
    heights = page.evaluate(
        "[...document.querySelectorAll('svg .bar')].map(b => b.getBBox().height)"
    )
    assert max(heights) > 100
    shown = page.locator("svg").first.bounding_box()
    assert 250 < shown["width"] <= width
    assert viewer.overflow() <= 0


def test_the_report_has_a_dark_face(browser: Any, report: Path) -> None:
    """Where the system wants it."""
    viewer = Viewer(browser, 1280)
    grounds = []
    for scheme in ("light", "dark"):
        viewer.page.emulate_media(color_scheme=scheme)
        page = viewer.open(report.as_uri())
        grounds.append(page.evaluate("getComputedStyle(document.body).backgroundColor"))
    assert grounds[0] != grounds[1]


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize(
    "path",
    [
        "/",
        "/workspace",
        "/workspace/weighted_labels",
        "/workspace/weight",
        "/workspace/round",
        "/labels",
        "/labels/kept",
        "/labels?sql=SELECT+frame,+k,+weight+FROM+weighted_labels",
        "/-/frame?frame=000003&k=1",
    ],
)
def test_a_served_page_loads_all_of_itself_from_here(
    browser: Any, pages: Pages, path: str, width: int
) -> None:
    """No fault, no foreign request, nothing beside the window."""
    viewer = Viewer(browser, width)
    viewer.open(pages.url + path)
    assert viewer.faults == []
    assert viewer.undecoded() == []
    assert viewer.overflow() <= 0


def test_a_reader_walks_from_a_question_to_a_picture(browser: Any, pages: Pages) -> None:
    """Question, row, frame, label, neighbour."""
    viewer = Viewer(browser, 1280)
    page = viewer.open(pages.url)
    page.get_by_role("link", name="kept").first.click()
    page.locator("tbody tr").first.wait_for()
    page.goto(pages.url + "/labels/weighted_labels")
    page.locator("td.col-k a").first.click()
    page.wait_for_load_state("load")
    assert "recomputed" in page.locator(".explanation").inner_text()
    assert page.locator("tr.chosen").count() == 1
    image = page.locator(".frame-picture")
    assert image.evaluate("i => i.naturalWidth") >= 800
    page.locator("a[rel=next]").click()
    page.wait_for_load_state("load")
    assert page.locator(".explanation").count() == 0
    assert viewer.undecoded() == []
    assert viewer.faults == []


def test_a_question_is_typed_and_answered(browser: Any, pages: Pages) -> None:
    """In the editor that the page brings along; a wrong one gets a line."""
    viewer = Viewer(browser, 1280)
    page = viewer.open(pages.url + "/workspace")
    page.get_by_role("button", name="Run SQL").or_(page.locator("input[type=submit]")).first.click()
    page.wait_for_load_state("load")
    assert page.locator(".message-error").count() == 0
    page.goto(pages.url + "/workspace?sql=DELETE+FROM+weight")
    assert "SELECT" in page.locator(".message-error").inner_text()
