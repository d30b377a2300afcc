"""Prepare the data set that all cells of a bench share."""

from curate.errors import DataError
from pipelines.bench.running import Say
from pipelines.bench.settings import SYNTHETIC, Bench
from pipelines.engine.progress import Progress, as_total
from pipelines.workspace.workspace import open_dataset


def make_data(bench: Bench, workers: int, say: Say, progress: Progress) -> None:
    """Simulate missing frames, or check that the data folder can be used.

    Raises:
        DataError: if the folder has no lists of training and validation frames.
    """
    settings = bench.settings
    if settings.data == SYNTHETIC and settings.frames and settings.val:
        _simulate(bench, settings.frames, settings.val, workers, say, progress)
    splits = open_dataset(bench.config(0)).splits()
    for name in ("train", "val"):
        if not splits.get(name):
            raise DataError(
                f"{bench.data}: ImageSets/{name}.txt is missing or empty; a bench needs frames in "
                "both train.txt and val.txt"
            )


def _simulate(
    bench: Bench, frames: int, val: int, workers: int, say: Say, progress: Progress
) -> None:
    from curate.simulation import simulate

    with progress.track("simulate", frames + val) as advance:
        seed, show = bench.settings.data_seed or 0, as_total(advance)
        simulate(bench.data, frames + val, seed, val_frames=val, workers=workers, progress=show)
    say(f"{frames} simulated training frames and {val} for validation in {bench.data}")
