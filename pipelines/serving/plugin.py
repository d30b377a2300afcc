"""What curate adds to Datasette: a page per frame, links to it, and the guard."""

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

# Also the package whose folders `templates` and `static` Datasette finds by this name.
NAME = "pipelines.serving"
_LOG = logging.getLogger(__name__)
_STYLE = f"/-/static-plugins/{NAME}/curate.css"


class CuratePlugin:
    """The hooks of one server.

    Args:
        host: on which it listens.
        frames: None where no workspace is at hand: then there are no pictures.
    """

    __name__ = NAME

    def __init__(self, host: str, frames: FramePages | None) -> None:
        self._host, self._frames = host, frames

    @hookimpl
    def asgi_wrapper(self) -> Any:
        """Put the guard before the pages."""

        def wrap(application: Application) -> Application:
            return guard(application, self._host)

        return wrap

    @hookimpl
    def extra_css_urls(self) -> list[str]:
        """Return the style, from this server as everything else."""
        return [_STYLE]

    @hookimpl
    def register_routes(self) -> list[tuple[str, Any]]:
        """Return the pages of frames."""
        if self._frames is None:
            return []

        async def page(datasette: Any, request: Any) -> Response:
            return await self._page(datasette, request)

        async def picture(request: Any) -> Response:
            return await self._picture(request)

        return [(r"^/-/frame$", page), (r"^/-/picture$", picture)]

    @hookimpl
    def handle_exception(self, datasette: Any, request: Any, exception: Exception) -> Any:
        """An error as a page or as JSON, in one line, and without a trace in the terminal."""

        async def page() -> Response:
            wrong_sql = isinstance(exception, sqlite3.Error | sqlite3.Warning)
            status = int(getattr(exception, "status", 400 if wrong_sql else 500))
            told = getattr(exception, "message", None) or str(exception) or type(exception).__name__
            if getattr(exception, "title", None) == "SQL Interrupted":
                told = (
                    f"this takes longer than {datasette.sql_time_limit_ms / 1000:g} s: ask for "
                    "less, or start curate serve with a greater --time-limit"
                )
            if status >= 500:
                _LOG.warning("%s: %s", type(exception).__name__, told)
            if request.path.endswith(".json"):
                return Response.json({"ok": False, "error": told}, status=status)
            text = await datasette.render_template(
                ["error.html"], {"status": status, "error": told}
            )
            return Response.html(text, status=status)

        return page

    @hookimpl
    def render_cell(self, row: Any, value: Any, column: str) -> Markup | None:
        """Numbers that can be read, and links from frames and labels to the page of the frame."""
        if isinstance(value, float):
            return Markup('<span class="number" title="{}">{:.4g}</span>').format(value, value)
        if self._frames is None or column not in {"frame", "frame_id", "k"}:
            return None
        own = dict(zip(row.keys(), row, strict=False))
        wanted = _address(own, with_label=column == "k")
        if wanted is None or value is None:
            return None
        shown = value["label"] if isinstance(value, Mapping) else value
        link = Markup('<a href="/-/frame?{}" title="picture and labels">{}</a>')
        return link.format(urlencode(wanted), shown)

    async def _page(self, datasette: Any, request: Any) -> Response:
        """Return the page of a frame, with the explanation of a label where one is asked for."""
        try:
            shown, k = await asyncio.to_thread(self._requested, request)
            told = await asyncio.to_thread(self._explanation, shown, k)
        except CurateError as error:
            page = await datasette.render_template(
                ["error.html"], {"status": 404, "error": str(error)}, request=request
            )
            return Response.html(page, status=404)
        context = {
            "shown": shown,
            "columns": shown.columns,
            "k": k,
            "explanation": told,
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
            raise ConfigError("no workspace at hand")
        return self._frames

    def _requested(self, request: Any) -> tuple[ShownFrame, int | None]:
        """The frame and the label that a request names; every part is looked up, none is a path."""
        wanted = {name: request.args.get(name) or None for name in ("frame", "policy")}
        numbers = {name: _number(request.args.get(name)) for name in ("id", "round", "k")}
        if wanted["frame"] is None and numbers["id"] is None:
            raise ConfigError("name a frame, as in /-/frame?frame=000008")
        shown = self._pages.find(wanted["frame"], numbers["id"], numbers["round"], wanted["policy"])
        return shown, numbers["k"]

    def _explanation(self, shown: ShownFrame, k: int | None) -> str | None:
        weighted = {row[0] for row in shown.labels if row[-1] is not None}
        if k is None or k not in weighted or shown.split != "unlabeled":
            return None
        return self._pages.explanation(shown, k)


def _address(row: Mapping[str, Any], *, with_label: bool) -> dict[str, Any] | None:
    """Return the parameters of the page of the frame that a row belongs to; None for no frame."""
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
    """Return the address of a frame's page or picture, with some of its parts changed."""
    wanted = {"frame": shown.name, "round": shown.round, "policy": shown.policy} | other
    return f"{path}?{urlencode(wanted)}"


def _number(text: str | None) -> int | None:
    """Return a small number of a request; None where none is given.

    Raises:
        ConfigError: if it is none.
    """
    if not text:
        return None
    if not text.isascii() or not text.isdigit() or len(text) > 9:
        raise ConfigError("id, round and k are numbers")
    return int(text)
