"""A server of a workspace's pages in a thread, and plain requests to it."""

import http.client
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote, urlencode

from pipelines.cli import app
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace
from support.toys import toy_document, write_toy_kitti


@dataclass(frozen=True)
class Answer:
    """A response; the names of headers are in lower case."""

    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def text(self) -> str:
        """Return the body as text."""
        return self.body.decode("utf-8", "replace")


@dataclass(frozen=True)
class Pages:
    """A running server.

    Attributes:
        port: on 127.0.0.1.
        workspace: the workspace that is served.
    """

    port: int
    workspace: Workspace

    @property
    def url(self) -> str:
        """Return the URL without a slash at the end."""
        return f"http://127.0.0.1:{self.port}"

    def get(
        self,
        path: str,
        method: str = "GET",
        headers: Mapping[str, str] | None = None,
        body: str | None = None,
        **parameters: object,
    ) -> Answer:
        """Send one request; the path is sent as it is written, dots included."""
        query = f"?{urlencode(parameters, quote_via=quote)}" if parameters else ""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120)
        connection.request(method, path + query, body=body, headers=dict(headers or {}))
        response = connection.getresponse()
        names = {name.lower(): value for name, value in response.getheaders()}
        found = Answer(response.status, names, response.read())
        connection.close()
        return found


def weighted_workspace(folder: Path) -> Workspace:
    """Return toy frames with the weights of one round, an export and a failed frame."""
    write_toy_kitti(folder / "kitti", frames=12, val=4)
    weights = folder / "detector.txt"
    weights.write_text("")
    config = make_config(toy_document(folder / "kitti", weights), "test")
    workspace = initialise(folder / "work", config, "0.25", "")
    app(["run", "-w", str(workspace.root)], standalone_mode=False)
    return workspace


@contextmanager
def running(served: object, workspace: Workspace, host: str = "127.0.0.1") -> Iterator[Pages]:
    """Return the server; it stops at the end of the block."""
    from pipelines.serving.application import application
    from pipelines.serving.server import listen, make_server

    with application(served, host) as pages, listen("127.0.0.1", 0) as taken:
        server = make_server(pages)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [taken]}, daemon=True)
        thread.start()
        try:
            yield Pages(taken.getsockname()[1], workspace)
        finally:
            server.should_exit = True
            thread.join(30)
