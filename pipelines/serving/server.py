"""The server: a port of this machine, until Ctrl-C."""

import socket
import webbrowser
from collections.abc import Callable
from typing import Any

from curate.errors import ConfigError


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that takes connections already.

    Args:
        host: name or address.
        port: 0 for any that is free.

    Raises:
        ConfigError: if it is in use, or not to be had.
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


def make_server(application: Any) -> Any:
    """Return the server of an ASGI application; its `run` takes the sockets.

    It says nothing of single requests, and gives slow readers three seconds at the end.
    """
    import uvicorn

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
    return uvicorn.Server(config)


def address(taken: socket.socket) -> str:
    """Return the URL of what a socket listens to."""
    host, port = taken.getsockname()[:2]
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


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
    told(address(taken))
    if browse:
        # The socket listens already: the first request waits until the server runs.
        webbrowser.open(address(taken))
    with taken:
        try:
            make_server(application).run(sockets=[taken])
        except KeyboardInterrupt:
            # uvicorn has ended in good order and passes the signal on.
            return
