"""curate simulate: simulate a LiDAR-camera data set in KITTI format."""

from pathlib import Path
from typing import Annotated, Optional

import typer

from pipelines.commands.options import JsonOption
from pipelines.reports.terminal import print_json


def simulate(
    directory: Annotated[Path, typer.Argument(help="Folder to write the data set to.")],
    frames: Annotated[
        int, typer.Option(min=1, help="Number of frames, validation frames included.")
    ] = 400,
    seed: Annotated[
        int, typer.Option(min=0, help="Random seed; the same seed gives the same files.")
    ] = 0,
    val: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(help="Number of validation frames among them; default: a quarter."),
    ] = None,
    workers: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="Number of processes; default: one per core."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Simulate a LiDAR-camera data set in KITTI format: ray-cast sweeps, images, labels.

    After an interruption the same command resumes; finished frames are kept.

    Example: curate simulate data/simulated --frames 400 --seed 0
    """
    from curate.simulation import simulate as run
    from pipelines.engine.progress import Bar, as_total

    with Bar().track("simulate", frames) as advance:
        progress = as_total(advance)
        run(directory, frames, seed, val_frames=val, workers=workers, progress=progress)
    if as_json:
        print_json({"folder": str(directory), "frames": frames, "val": val, "seed": seed})
        return
    typer.echo(f"{frames} frames in {directory}, in KITTI's layout; labels in training/label_2")
