"""curate serve: show databases and images of frames in a browser."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from pipelines.commands.options import WorkspaceOption

if TYPE_CHECKING:
    from pipelines.serving.application import Served


def serve(
    folder: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Argument(metavar="[WORKSPACE]", help="The same as --workspace.", show_default=False),
    ] = None,
    file: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Serve only this exported label file."),
    ] = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="TCP port; 0 takes any free one.")
    ] = 8001,
    host: Annotated[
        str,
        typer.Option(help="Address to listen on; the default is reachable from this machine only."),
    ] = "127.0.0.1",
    time_limit: Annotated[
        float, typer.Option(min=0.1, max=600, help="Seconds after which a query is stopped.")
    ] = 10.0,
    browse: Annotated[bool, typer.Option("--open", help="Open it in a browser.")] = False,
    workspace: WorkspaceOption = None,
) -> None:
    """Serve the labels to a browser: tables, SQL, the named queries, an image per frame.

    The workspace's database and the exported labels.sqlite are opened read-only. Nothing is loaded
    from the network. Ctrl-C stops the server.

    Example: curate serve --port 8001 --open
    """
    from dataclasses import replace

    from pipelines.serving.application import application
    from pipelines.serving.guard import is_loopback
    from pipelines.serving.server import listen
    from pipelines.serving.server import serve as run_server
    from pipelines.serving.sources import choose

    served = replace(choose(folder, workspace, file), time_limit_s=time_limit)
    with application(served, host) as pages:
        listener = listen(host, port)
        if not is_loopback(host):
            typer.echo(
                f"warning: everyone who can reach {host} can read these labels and images", err=True
            )
        run_server(pages, listener, lambda url: _announce(served, url), browse=browse)


def _announce(served: "Served", url: str) -> None:
    for name, path in served.files.items():
        typer.echo(f"{name}: {path}")
    typer.echo(f"serving at {url} until Ctrl-C")
