"""curate view: a picture of one frame."""

from pathlib import Path
from typing import Annotated, Optional

import typer

from pipelines.commands.options import (
    JsonOption,
    PolicyOption,
    WorkspaceOption,
    open_workspace,
    print_json,
)


def view(
    frame: Annotated[str, typer.Argument(help="Frame id, e.g. 000008.")],
    round_number: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option("--round", min=1, help="Round; default: the last with predictions."),
    ] = None,
    policy: PolicyOption = None,
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="PNG file; default: one in the workspace's folder pictures."),
    ] = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Draw a frame: its image and a bird's eye view with all boxes, coloured by weight.

    Predictions are solid, repredictions dashed, ground truth dotted; ground truth of labeled and
    val frames only. Each label tells its weight, score and LiDAR points where there is room.

    Example: curate view 000008 --round 1 --policy pspsl --output 000008.png
    """
    from pipelines.pictures import draw_view

    path = draw_view(open_workspace(workspace), frame, round_number, policy, output)
    if as_json:
        print_json({"picture": str(path)})
    else:
        typer.echo(f"picture: {path}")


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(view)
