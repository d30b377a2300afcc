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
    """Return one browser for all tests."""
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def report(weighted: Workspace) -> Path:
    """Return the report of the only round."""
    return write_report(weighted, None, None)[0]


@pytest.mark.parametrize("width", WIDTHS)
def test_the_report_is_displayed_correctly(browser: Any, report: Path, width: int) -> None:
    """Charts have bars, tables have rows, images are decoded, nothing overflows the window."""
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


def test_the_report_has_a_dark_mode(browser: Any, report: Path) -> None:
    """If the system requests it."""
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
def test_a_served_page_loads_only_from_its_server(
    browser: Any, pages: Pages, path: str, width: int
) -> None:
    """No error, no external request, nothing overflows the window."""
    viewer = Viewer(browser, width)
    viewer.open(pages.url + path)
    assert viewer.faults == []
    assert viewer.undecoded() == []
    assert viewer.overflow() <= 0


def test_links_lead_from_a_query_to_an_image(browser: Any, pages: Pages) -> None:
    """Query, row, frame, label, neighbour."""
    viewer = Viewer(browser, 1280)
    page = viewer.open(pages.url)
    page.get_by_role("link", name="kept").first.click()
    page.locator("tbody tr").first.wait_for()
    page.wait_for_load_state("load")  # leaving earlier would abort the requests of this page
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


def test_a_query_can_be_typed_and_run(browser: Any, pages: Pages) -> None:
    """In the editor of the page; a wrong one gets a one-line error."""
    viewer = Viewer(browser, 1280)
    page = viewer.open(pages.url + "/workspace")
    page.get_by_role("button", name="Run SQL").or_(page.locator("input[type=submit]")).first.click()
    page.wait_for_load_state("load")
    assert page.locator(".message-error").count() == 0
    page.goto(pages.url + "/workspace?sql=DELETE+FROM+weight")
    assert "SELECT" in page.locator(".message-error").inner_text()
