"""The HTTP server, which runs until Ctrl-C."""

import socket
import webbrowser
from collections.abc import Callable
from typing import Any

from curate.errors import ConfigError


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that accepts connections.

    Args:
        host: name or address.
        port: TCP port; 0 for any free one.

    Raises:
        ConfigError: if the port is in use or the address is not available.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family, backlog=128)
    except (OSError, OverflowError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(
            f"serve: cannot listen on {host}:{port}: {reason}; choose another one with "
            "--port (0 takes any free one)"
        ) from error


def make_server(application: Any) -> Any:
    """Return the server of an ASGI application; its `run` takes the sockets.

    It does not log requests, and gives open connections three seconds when it stops.
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


def address(listener: socket.socket) -> str:
    """Return the URL of a listening socket."""
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def serve(
    application: Any, listener: socket.socket, announce: Callable[[str], None], *, browse: bool
) -> None:
    """Serve until Ctrl-C or SIGTERM.

    Args:
        application: an ASGI application.
        listener: the listening socket; it is closed at the end.
        announce: called with the URL.
        browse: whether to open the URL in a browser.
    """
    announce(address(listener))
    if browse:
        # The socket already listens: the first request waits until the server runs.
        webbrowser.open(address(listener))
    with listener:
        try:
            make_server(application).run(sockets=[listener])
        except KeyboardInterrupt:
            # uvicorn has shut down and passes the signal on.
            return
