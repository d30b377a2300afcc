"""Protection of the pages: which requests are accepted, and what a browser may load."""

from collections.abc import Awaitable, Callable, MutableMapping
from ipaddress import ip_address
from typing import Any

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

_METHODS = frozenset({"GET", "HEAD"})
# Datasette's pages under /-/ show paths of this machine; only these are served.
_SERVED_PATHS = ("/-/static/", "/-/static-plugins/", "/-/frame", "/-/picture")
_CONTENT_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'"
)
_HEADERS = (
    (b"content-security-policy", _CONTENT_POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
)


def is_loopback(host: str) -> bool:
    """Return whether a server that listens on this host is reachable from this machine only."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def guard(application: Application, host: str) -> Application:
    """Return the application with checks of every request and security headers.

    A page of another site that is open in the same browser can send requests to this machine. If
    the server listens on loopback, requests with an unexpected host name (DNS rebinding) are
    rejected. Requests by pages of other sites are always rejected, unless the user follows a link.

    Args:
        application: an ASGI application.
        host: name or address on which it listens.
    """
    names = frozenset({"localhost", "127.0.0.1", "[::1]", host}) if is_loopback(host) else None

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await application(scope, receive, send)
            return
        rejection = _rejection(scope, names)
        if rejection is not None:
            await _reject(_with_headers(send), *rejection)
            return
        await application(scope, receive, _with_headers(send))

    return guarded


def _rejection(scope: Scope, names: frozenset[str] | None) -> tuple[int, str] | None:
    """Return status and reason if a request is rejected."""
    headers = {name.lower(): value.decode("latin-1") for name, value in scope["headers"]}
    if scope["method"] not in _METHODS:
        return 405, "these pages are read-only"
    if names is not None and _host_name(headers.get(b"host", "")) not in names:
        return 403, "use the address that curate serve printed"
    other_site = headers.get(b"sec-fetch-site", "none") in {"cross-site", "same-site"}
    if other_site and headers.get(b"sec-fetch-dest") != "document":
        return 403, "requests by pages of other sites are rejected"
    path = scope["path"]
    # A redirect to a path with two slashes at its start would lead to another site.
    if path.startswith(("//", "/-/", "/_internal")) and not path.startswith(_SERVED_PATHS):
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
    """Return a `send` that adds the security headers to every response."""

    async def sending(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", []), *_HEADERS]
        await send(message)

    return sending
