"""What stands before the pages: who may ask, what may be asked, and what a browser may load."""

from collections.abc import Awaitable, Callable, MutableMapping
from ipaddress import ip_address
from typing import Any

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

_METHODS = frozenset({"GET", "HEAD"})
# Datasette's own pages about itself tell paths of the machine; these are what is left of them.
_INNER = ("/-/static/", "/-/static-plugins/", "/-/frame", "/-/picture")
_MAY_LOAD = (
    "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'"
)
_HEADERS = (
    (b"content-security-policy", _MAY_LOAD.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
)


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a server that listens there."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def guard(application: Application, host: str) -> Application:
    """Return the application behind its guard.

    A page of some other site that is open in the same browser can send requests to this machine.
    Where the server listens on loopback, requests under a foreign name (DNS rebinding) are refused;
    requests that another site's page makes are refused everywhere, except for a followed link.

    Args:
        application: an ASGI application.
        host: on which it listens.
    """
    names = frozenset({"localhost", "127.0.0.1", "[::1]", host}) if is_loopback(host) else None

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await application(scope, receive, send)
            return
        refusal = _rejection(scope, names)
        if refusal is not None:
            await _reject(_with_headers(send), *refusal)
            return
        await application(scope, receive, _with_headers(send))

    return guarded


def _rejection(scope: Scope, names: frozenset[str] | None) -> tuple[int, str] | None:
    """Status and reason where a request is refused."""
    headers = {name.lower(): value.decode("latin-1") for name, value in scope["headers"]}
    if scope["method"] not in _METHODS:
        return 405, "these pages are for reading"
    if names is not None and _host_name(headers.get(b"host", "")) not in names:
        return 403, "ask under the name that curate serve printed"
    foreign = headers.get(b"sec-fetch-site", "none") in {"cross-site", "same-site"}
    if foreign and headers.get(b"sec-fetch-dest") != "document":
        return 403, "not for pages of other sites"
    path = scope["path"]
    # Two slashes would begin another site's name where such a path were redirected to.
    if path.startswith(("//", "/-/", "/_internal")) and not path.startswith(_INNER):
        return 404, "no such page"
    return None


def _host_name(header: str) -> str:
    """Return a Host header without its port."""
    name, colon, port = header.rpartition(":")
    return name if colon and port.isdigit() else header


async def _reject(send: Send, status: int, reason: str) -> None:
    body = f"{reason}\n".encode()
    headers = [(b"content-type", b"text/plain"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})


def _with_headers(send: Send) -> Send:
    """Add the headers of every answer."""

    async def sending(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", []), *_HEADERS]
        await send(message)

    return sending
