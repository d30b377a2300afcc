"""The server: a port of this machine, until Ctrl-C."""

import socket
import webbrowser
from collections.abc import Callable
from typing import Any

from curate.errors import ConfigError


def listen(host: str, port: int) -> socket.socket:
    """A socket that takes connections already.

    Args:
        host: name or address.
        port: 0 for any that is free.

    Raises:
        ConfigError: it is in use, or not to be had.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family, backlog=128)
    except (OSError, OverflowError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(
            f"serve: cannot listen on {host}:{port}: {reason}; name another with --port "
            "(0 takes any that is free)"
        ) from error


def serve(
    application: Any, taken: socket.socket, told: Callable[[str], None], *, browse: bool
) -> None:
    """Answers until Ctrl-C or SIGTERM.

    Args:
        application: an ASGI application.
        taken: where it listens; closed at the end.
        told: is given the address.
        browse: whether to show it in a browser.
    """
    import uvicorn

    host, port = taken.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    url = f"http://{shown}:{port}/"
    config = uvicorn.Config(
        application,
        log_level="error",
        access_log=False,
        lifespan="on",
        server_header=False,
        ws="none",
        limit_concurrency=64,
        timeout_graceful_shutdown=3,
    )
    told(url)
    if browse:
        # The socket listens already: the first request waits until the server runs.
        webbrowser.open(url)
    with taken:
        try:
            uvicorn.Server(config).run(sockets=[taken])
        except KeyboardInterrupt:
            # uvicorn has ended in good order and passes the signal on.
            return
