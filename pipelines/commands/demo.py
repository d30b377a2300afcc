"""curate demo: run the whole pipeline on simulated data."""

from pathlib import Path
from typing import Annotated, Optional

import typer


def demo(
    directory: Annotated[
        Path, typer.Argument(help="Folder for the data set and the workspace.")
    ] = Path("demo"),
    frames: Annotated[
        int, typer.Option(min=8, help="Number of training frames to simulate.")
    ] = 200,
    val: Annotated[int, typer.Option(min=4, help="Number of validation frames to simulate.")] = 120,
    labeled: Annotated[
        float, typer.Option(help="Share of the training frames that are labeled.")
    ] = 0.04,
    rounds: Annotated[int, typer.Option(min=1, help="Number of rounds.")] = 1,
    steps: Annotated[int, typer.Option(min=1, help="Optimiser steps of each training.")] = 250,
    seed: Annotated[
        int, typer.Option(min=0, help="Random seed of simulation, split and training.")
    ] = 0,
    workers: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="Number of processes; default: one per core."),
    ] = None,
) -> None:
    """Run the whole pipeline on simulated LiDAR-camera data, offline, in minutes on two cores.

    Simulates a data set, trains a teacher on the few labeled frames, weights its predictions on the
    others, trains students, and evaluates labels and detectors. After an interruption the same
    command resumes.

    Example: curate demo --rounds 1
    """
    from pipelines.demo import Demo, run_demo
    from pipelines.reports.terminal import print_line

    run_demo(
        Demo(
            directory=directory.resolve(),
            frames=frames,
            val=val,
            labeled=labeled,
            rounds=rounds,
            steps=steps,
            seed=seed,
            workers=workers,
        ),
        print_line,
    )
