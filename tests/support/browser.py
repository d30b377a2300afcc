"""A headless Chromium without a network."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

WIDTHS = (1280, 400)
_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


class Viewer:
    """Open pages; every request to another host, every error and failure is recorded as a fault.

    Args:
        browser: of Playwright.
        width: of the window in pixels.
    """

    def __init__(self, browser: Any, width: int) -> None:
        self.faults: list[str] = []
        self.width = width
        self._context = browser.new_context(viewport={"width": width, "height": 900})
        self._context.route("**/*", self._pass_or_abort)
        self.page = self._context.new_page()
        self.page.set_default_timeout(120_000)
        self.page.on("pageerror", lambda error: self.faults.append(f"error: {error}"))
        self.page.on("console", self._on_console)
        self.page.on("requestfailed", lambda request: self.faults.append(f"failed: {request.url}"))
        self.page.on("response", self._on_response)

    def open(self, url: str) -> Any:
        """Return the page, completely loaded."""
        self.page.goto(url, wait_until="load")
        return self.page

    def overflow(self) -> int:
        """Return by how many pixels the page is wider than the window."""
        return int(self.page.evaluate("document.documentElement.scrollWidth")) - self.width

    def undecoded(self) -> list[str]:
        """Return the images of the page that could not be decoded."""
        script = "[...document.images].filter(i => !(i.complete && i.naturalWidth > 0))"
        found: list[str] = self.page.evaluate(f"{script}.map(i => i.alt)")
        return found

    def _pass_or_abort(self, route: Any) -> None:
        if route.request.url.startswith(("file:", "data:", "http://127.0.0.1:")):
            route.continue_()
        else:
            route.abort("internetdisconnected")

    def _on_console(self, message: Any) -> None:
        if message.type in {"error", "warning"}:
            self.faults.append(f"console: {message.text}")

    def _on_response(self, response: Any) -> None:
        if response.status >= 400:
            self.faults.append(f"{response.status}: {response.url}")


@contextmanager
def chromium() -> Iterator[Any]:
    """Return a browser; skip the test if none is installed."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="the extra [browser] is not installed"
    )
    path = next(filter(None, map(shutil.which, _NAMES)), None)
    if path is None:
        pytest.skip("no Chromium is installed")
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(
            executable_path=path, args=["--no-sandbox", "--disable-gpu"]
        )
        yield browser
        browser.close()
