"""curate's plugin for Datasette: a page per frame, links to it, and the guard."""

import asyncio
import logging
import sqlite3
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlencode

from datasette import Response, hookimpl
from markupsafe import Markup

from curate.errors import ConfigError, CurateError
from pipelines.serving.guard import Application, guard
from pipelines.serving.shown_frames import FramePages, ShownFrame

# The package in which Datasette finds the folders `templates` and `static`.
NAME = "pipelines.serving"
_LOG = logging.getLogger(__name__)
_STYLE = f"/-/static-plugins/{NAME}/curate.css"


class CuratePlugin:
    """The hooks of one server.

    Args:
        host: name or address on which it listens.
        frames: the pages of frames; None without a workspace.
    """

    __name__ = NAME

    def __init__(self, host: str, frames: FramePages | None) -> None:
        self._host, self._frames = host, frames

    @hookimpl
    def asgi_wrapper(self) -> Any:
        """Wrap the application in the guard."""

        def wrap(application: Application) -> Application:
            return guard(application, self._host)

        return wrap

    @hookimpl
    def extra_css_urls(self) -> list[str]:
        """Return the URL of the style sheet, on this server."""
        return [_STYLE]

    @hookimpl
    def register_routes(self) -> list[tuple[str, Any]]:
        """Return the routes of the pages and images of frames."""
        if self._frames is None:
            return []

        async def page(datasette: Any, request: Any) -> Response:
            return await self._page(datasette, request)

        async def picture(request: Any) -> Response:
            return await self._picture(request)

        return [(r"^/-/frame$", page), (r"^/-/picture$", picture)]

    @hookimpl
    def handle_exception(self, datasette: Any, request: Any, exception: Exception) -> Any:
        """Return an error as a page or as JSON, in one line; no traceback is logged."""

        async def page() -> Response:
            wrong_sql = isinstance(exception, sqlite3.Error | sqlite3.Warning)
            status = int(getattr(exception, "status", 400 if wrong_sql else 500))
            message = (
                getattr(exception, "message", None) or str(exception) or type(exception).__name__
            )
            if getattr(exception, "title", None) == "SQL Interrupted":
                message = (
                    f"the query takes longer than {datasette.sql_time_limit_ms / 1000:g} s: select "
                    "less, or start curate serve with a larger --time-limit"
                )
            if status >= 500:
                _LOG.warning("%s: %s", type(exception).__name__, message)
            if request.path.endswith(".json"):
                return Response.json({"ok": False, "error": message}, status=status)
            text = await datasette.render_template(
                ["error.html"], {"status": status, "error": message}
            )
            return Response.html(text, status=status)

        return page

    @hookimpl
    def render_cell(self, row: Any, value: Any, column: str) -> Markup | None:
        """Show a number with four digits, and a frame or label as a link to the frame's page."""
        if isinstance(value, float):
            return Markup('<span class="number" title="{}">{:.4g}</span>').format(value, value)
        if self._frames is None or column not in {"frame", "frame_id", "k"}:
            return None
        cells = dict(zip(row.keys(), row, strict=False))
        parameters = _parameters(cells, with_label=column == "k")
        if parameters is None or value is None:
            return None
        text = value["label"] if isinstance(value, Mapping) else value
        link = Markup('<a href="/-/frame?{}" title="picture and labels">{}</a>')
        return link.format(urlencode(parameters), text)

    async def _page(self, datasette: Any, request: Any) -> Response:
        """Return the page of a frame, with the explanation of a label if one is requested."""
        try:
            shown, k = await asyncio.to_thread(self._requested, request)
            explanation = await asyncio.to_thread(self._explanation, shown, k)
        except CurateError as error:
            page = await datasette.render_template(
                ["error.html"], {"status": 404, "error": str(error)}, request=request
            )
            return Response.html(page, status=404)
        context = {
            "shown": shown,
            "columns": shown.columns,
            "k": k,
            "explanation": explanation,
            "picture": _link("/-/picture", shown),
            "link": lambda **other: _link("/-/frame", shown, **other),
        }
        return Response.html(
            await datasette.render_template(["frame.html"], context, request=request)
        )

    async def _picture(self, request: Any) -> Response:
        """Return the picture of a frame."""
        try:
            shown, _ = await asyncio.to_thread(self._requested, request)
            content = await asyncio.to_thread(self._pages.picture, shown)
        except CurateError as error:
            return Response.text(str(error), status=404)
        return Response(content, content_type="image/jpeg")

    @property
    def _pages(self) -> FramePages:
        if self._frames is None:
            raise ConfigError("no workspace is open; images of frames need one")
        return self._frames

    def _requested(self, request: Any) -> tuple[ShownFrame, int | None]:
        """Return the requested frame and label; they are looked up, never used as paths."""
        names = {name: request.args.get(name) or None for name in ("frame", "policy")}
        numbers = {name: _number(request.args.get(name)) for name in ("id", "round", "k")}
        if names["frame"] is None and numbers["id"] is None:
            raise ConfigError("specify a frame, as in /-/frame?frame=000008")
        shown = self._pages.find(names["frame"], numbers["id"], numbers["round"], names["policy"])
        return shown, numbers["k"]

    def _explanation(self, shown: ShownFrame, k: int | None) -> str | None:
        weights = shown.columns.index("v")
        weighted = {row[0] for row in shown.labels if row[weights] is not None}
        if k is None or k not in weighted or shown.split != "unlabeled":
            return None
        return self._pages.explanation(shown, k)


def _parameters(row: Mapping[str, Any], *, with_label: bool) -> dict[str, Any] | None:
    """Return the URL parameters of the page of a row's frame; None if the row has no frame."""
    plain = {
        name: each["value"] if isinstance(each, Mapping) else each for name, each in row.items()
    }
    if plain.get("frame") is not None:
        found = {"frame": plain["frame"]}
    elif plain.get("frame_id") is not None:
        found = {"id": plain["frame_id"]}
    else:
        return None
    names = ("round", "policy", "k") if with_label else ("round", "policy")
    return found | {name: plain[name] for name in names if plain.get(name) is not None}


def _link(path: str, shown: ShownFrame, **other: Any) -> str:
    """Return the address of a frame's page or image, with some parameters replaced."""
    parameters = {"frame": shown.name, "round": shown.round, "policy": shown.policy} | other
    return f"{path}?{urlencode(parameters)}"


def _number(text: str | None) -> int | None:
    """Return a small number of a request; None if it is absent.

    Raises:
        ConfigError: if it is not a number of at most nine digits.
    """
    if not text:
        return None
    if not text.isascii() or not text.isdigit() or len(text) > 9:
        raise ConfigError("id, round and k must be numbers of at most nine digits")
    return int(text)
