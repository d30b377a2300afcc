"""Simulates a LiDAR-camera data set in KITTI's layout, with all cores, resumable at any moment.

Frame i depends on (seed, i) alone. Its files are renamed into place one by one, the label last: a
frame with a label is whole, and a run that was killed goes on with the others.
"""

import json
import logging
import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path

import cv2
import numpy as np

from curate.datasets.kitti.labels import from_annotations, write_objects
from curate.errors import ConfigError, CurateError, DataError
from curate.files.atomic import replace_file
from curate.files.paths import StrPath
from curate.simulation.camera import render
from curate.simulation.labels import annotate
from curate.simulation.lidar import sweep
from curate.simulation.rig import CameraRig
from curate.simulation.scene import Caster, Scene

_log = logging.getLogger(__name__)

SETTINGS_FILE = "simulation.json"
SEMANTIC_FOLDER = "semantic_2"
_FORMAT = 1  # raised whenever the same seed gives other frames
_FOLDERS = {
    "velodyne": ".bin",
    "image_2": ".png",
    SEMANTIC_FOLDER: ".png",
    "calib": ".txt",
    "label_2": ".txt",
}


@dataclass(frozen=True)
class SimulationSettings:
    """What decides the content of a simulated data set; stored in simulation.json."""

    format: int
    seed: int
    frames: int
    val_frames: int


def simulate(
    directory: StrPath,
    frames: int,
    seed: int,
    *,
    val_frames: int | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a simulated data set in KITTI's layout; frames that are already there are kept.

    Args:
        directory: the root; gets training/{velodyne,image_2,semantic_2,calib,label_2} and
            ImageSets/{train,val,trainval}.txt.
        frames: how many.
        seed: decides every frame, whatever the number of workers.
        val_frames: how many of them, the last, are the split val; default a quarter.
        workers: processes; default one per core.
        progress: called with (frames done, frames).

    Scripts that call it with more than one worker do so below `if __name__ == "__main__":`, since
    each worker runs the script's other lines.

    Raises:
        CurateError: if a worker was killed, or the script lacks that line.
        ConfigError: if a number is out of range, or the directory holds another simulation.
        DataError: if the directory holds other data or cannot be written, or its simulation.json is
            damaged.
    """
    directory = Path(directory)
    settings = _settings(frames, seed, val_frames)
    if workers is not None and workers < 1:
        raise ConfigError(f"workers must be at least 1, not {workers}")
    try:
        _claim(directory, settings)
        _complete(directory / "training", settings, workers or os.cpu_count() or 1, progress)
        _write_splits(directory, settings)
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"{directory}: cannot be written: {reason}") from error


def _complete(
    home: Path,
    settings: SimulationSettings,
    workers: int,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Make the frames that are not there yet."""
    for leftover in home.glob("*/.*.partial"):  # of a run that was killed
        leftover.unlink()
    missing = [index for index in range(settings.frames) if not _is_whole(home, index)]
    done = settings.frames - len(missing)
    if progress:
        progress(done, settings.frames)
    task = partial(_simulate_frame, home, settings.seed)
    with _mapped(task, missing, workers) as finished:
        for _ in finished:
            done += 1
            if progress:
                progress(done, settings.frames)
    _log.info("%s: %d simulated frames, %d made now", home, settings.frames, len(missing))


def _settings(frames: int, seed: int, val_frames: int | None) -> SimulationSettings:
    """Return the settings, checked."""
    val = frames // 4 if val_frames is None else val_frames
    if not 1 <= frames <= 999_999:
        raise ConfigError(f"frames must be 1 to 999999, not {frames}")
    if seed < 0:
        raise ConfigError(f"seed must not be negative, is {seed}")
    if not 0 <= val < frames:
        raise ConfigError(f"val_frames must be 0 to {frames - 1} of {frames} frames, not {val}")
    return SimulationSettings(_FORMAT, seed, frames, val)


def _claim(directory: Path, settings: SimulationSettings) -> None:
    """Mark the directory with the settings, or makes sure that it is marked with the same."""
    marker = directory / SETTINGS_FILE
    if not marker.exists():
        if (directory / "training").exists():
            raise DataError(
                f"{directory}: holds a data set that was not simulated (no {SETTINGS_FILE}); "
                "name another directory"
            )
        replace_file(marker, (json.dumps(asdict(settings), indent=2) + "\n").encode())
        return
    try:
        stored = SimulationSettings(**json.loads(marker.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise DataError(f"{marker}: is damaged ({error}); delete the directory") from error
    if stored != settings:
        raise ConfigError(
            f"{directory}: holds another simulation (frames={stored.frames} seed={stored.seed} "
            f"val_frames={stored.val_frames} format={stored.format}, asked for "
            f"frames={settings.frames} seed={settings.seed} val_frames={settings.val_frames} "
            f"format={settings.format}); name another directory or delete this one"
        )


def _frame_file(home: Path, folder: str, index: int) -> Path:
    return home / folder / f"{index:06d}{_FOLDERS[folder]}"


def _is_whole(home: Path, index: int) -> bool:
    """Return whether all files of a frame are there."""
    return all(_frame_file(home, folder, index).exists() for folder in _FOLDERS)


def _simulate_frame(home: Path, seed: int, index: int) -> None:
    """Make one frame and writes its files, the label last."""
    layout, laser, lens = (np.random.default_rng([seed, index, part]) for part in range(3))
    scene = Scene.draw(layout)
    rig = CameraRig.draw(lens)
    caster = Caster(scene.vertices, scene.triangles)
    points = sweep(scene, caster, laser)
    view = render(scene, caster, rig, lens)
    annotations = annotate(scene, view, rig)
    replace_file(_frame_file(home, "velodyne", index), points.astype("<f4").tobytes())
    replace_file(_frame_file(home, "image_2", index), _png(view.image[..., ::-1]))
    replace_file(_frame_file(home, SEMANTIC_FOLDER, index), _png(view.semantic))
    replace_file(_frame_file(home, "calib", index), rig.kitti_text().encode())
    write_objects(
        _frame_file(home, "label_2", index), from_annotations(annotations, rig.calibration)
    )


def _png(pixels: np.ndarray) -> bytes:
    """Return a PNG file of grey or BGR pixels; OpenCV's default compression is its fast one."""
    _, encoded = cv2.imencode(".png", pixels)
    return bytes(encoded)


@contextmanager
def _mapped(
    task: Callable[[int], None], indices: Sequence[int], workers: int
) -> Iterator[Iterator[None]]:
    """The results of a task over all indices, in this process or in several."""
    workers = min(workers, len(indices))
    if workers <= 1:
        yield map(task, indices)
        return
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        # A worker that runs its parent's script, which calls without a main guard. The parent says
        # so, in one line; what multiprocessing would raise here is a page per worker.
        sys.exit(1)
    with ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), initializer=_start_worker
    ) as pool:
        try:
            yield pool.map(task, indices)
        except BrokenProcessPool:
            raise CurateError(
                "a simulation process was killed, or it ran a script that calls `simulate` outside "
                'of `if __name__ == "__main__":`; mend that, or run the same again: it goes on'
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)


def _start_worker() -> None:
    """One thread per process, and no process that outlives a killed parent."""
    cv2.setNumThreads(1)
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _write_splits(directory: Path, settings: SimulationSettings) -> None:
    """The lists of frames; written last, so that they never name a frame that is not there."""
    names = [f"{index:06d}\n" for index in range(settings.frames)]
    train = settings.frames - settings.val_frames
    for split, part in (("train", names[:train]), ("val", names[train:]), ("trainval", names)):
        replace_file(directory / "ImageSets" / f"{split}.txt", "".join(part).encode())
