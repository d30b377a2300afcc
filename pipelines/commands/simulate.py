"""curate simulate: a LiDAR-camera data set in KITTI format."""

from pathlib import Path
from typing import Annotated, Optional

import typer


def simulate(
    directory: Annotated[Path, typer.Argument(help="Folder for the data set.")],
    frames: Annotated[int, typer.Option(min=1, help="How many frames, val included.")] = 400,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same bytes.")] = 0,
    val: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(help="How many of them are for validation; default: a quarter."),
    ] = None,
    workers: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="Processes; default: all cores."),
    ] = None,
) -> None:
    """Simulate a LiDAR-camera data set in KITTI format: ray-cast sweeps, images, labels.

    A killed simulation continues where it was.

    Example: curate simulate data/simulated --frames 400 --seed 0
    """
    from curate.simulation import simulate as run
    from pipelines.engine.progress import Bar, as_total

    with Bar().track("simulate", frames) as advance:
        shown = as_total(advance)
        run(directory, frames, seed, val_frames=val, workers=workers, progress=shown)
    typer.echo(
        f"{frames} frames in {directory}, as KITTI lays them out; labels in training/label_2"
    )


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(simulate)
