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
    sequences: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            min=1,
            help="Number of sequences of equal length, in which the vehicle and the objects move; "
            "default: single frames.",
        ),
    ] = None,
    workers: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="Number of processes; default: one per core."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Simulate a LiDAR-camera data set in KITTI format: ray-cast sweeps, images, labels.

    With --sequences, the frames are those of drives at 10 Hz, with poses, in a plain folder; each
    split has whole sequences. After an interruption the same command resumes; finished frames are
    kept.

    Example: curate simulate data/simulated --frames 400 --seed 0

    Example: curate simulate data/drives --frames 400 --sequences 20
    """
    from curate.simulation import simulate as run
    from pipelines.engine.progress import Bar, as_total

    with Bar().track("simulate", frames) as advance:
        progress = as_total(advance)
        run(
            *(directory, frames, seed),
            val_frames=val,
            workers=workers,
            progress=progress,
            sequences=sequences,
        )
    if as_json:
        facts = {"folder": str(directory), "frames": frames, "val": val, "seed": seed}
        print_json(facts if sequences is None else {**facts, "sequences": sequences})
        return
    if sequences is not None:
        typer.echo(
            f"{frames} frames in {sequences} sequences in {directory}; read them with "
            "curate init --dataset folder; labels in label_2"
        )
        return
    typer.echo(f"{frames} frames in {directory}, in KITTI's layout; labels in training/label_2")
