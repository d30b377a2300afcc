"""Writer of simulated LiDAR-camera data sets in KITTI's layout.

Frame i depends only on (seed, i), so frames are simulated in parallel. Each file is written
atomically, and the label last. A frame with all files is complete; after a kill, the next run
resumes with the missing frames.
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
_FORMAT = 2  # incremented whenever the same seed gives different frames
_FOLDERS = {
    "velodyne": ".bin",
    "image_2": ".png",
    SEMANTIC_FOLDER: ".png",
    "calib": ".txt",
    "label_2": ".txt",
}


@dataclass(frozen=True)
class SimulationSettings:
    """The settings that determine a simulated data set; stored in simulation.json."""

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
    """Write a simulated data set in KITTI's layout; existing frames are kept.

    A script that calls this function with more than one worker must do so below
    `if __name__ == "__main__":`, because each worker process imports the script.

    Args:
        directory: the root folder, where training/{velodyne,image_2,semantic_2,calib,label_2} and
            ImageSets/{train,val,trainval}.txt are written.
        frames: number of frames.
        seed: seed of all frames; the number of workers does not change them.
        val_frames: number of frames at the end that form the split val; a quarter by default.
        workers: number of processes; one per core by default.
        progress: called with (frames done, frames).

    Raises:
        CurateError: if a worker was killed, or the script has no main guard.
        ConfigError: if a number is out of range, or the directory contains another simulation.
        DataError: if the directory contains other data or cannot be written, or its simulation.json
            is damaged.
    """
    directory = Path(directory)
    settings = _settings(frames, seed, val_frames)
    if workers is not None and workers < 1:
        raise ConfigError(f"workers must be at least 1, not {workers}")
    try:
        _check_settings_file(directory, settings)
        _simulate_missing(
            directory / "training", settings, workers or os.cpu_count() or 1, progress
        )
        _write_splits(directory, settings)
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"{directory}: cannot be written: {reason}") from error


def _simulate_missing(
    home: Path,
    settings: SimulationSettings,
    workers: int,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Simulate the frames that are not complete."""
    for leftover in home.glob("*/.*.partial"):  # from a run that was killed
        leftover.unlink()
    missing = [index for index in range(settings.frames) if not _is_complete(home, index)]
    done = settings.frames - len(missing)
    if progress:
        progress(done, settings.frames)
    task = partial(_simulate_frame, home, settings.seed)
    with _parallel_map(task, missing, workers) as results:
        for _ in results:
            done += 1
            if progress:
                progress(done, settings.frames)
    _log.info("%s: %d simulated frames, %d of them new", home, settings.frames, len(missing))


def _settings(frames: int, seed: int, val_frames: int | None) -> SimulationSettings:
    """Return the settings after checking them."""
    val = frames // 4 if val_frames is None else val_frames
    if not 1 <= frames <= 999_999:
        raise ConfigError(f"frames must be 1 to 999999, not {frames}")
    if seed < 0:
        raise ConfigError(f"seed must be at least 0, not {seed}")
    if not 0 <= val < frames:
        raise ConfigError(f"val_frames must be 0 to {frames - 1} of {frames} frames, not {val}")
    return SimulationSettings(_FORMAT, seed, frames, val)


def _check_settings_file(directory: Path, settings: SimulationSettings) -> None:
    """Write simulation.json, or check that an existing one has the same settings."""
    path = directory / SETTINGS_FILE
    if not path.exists():
        if (directory / "training").exists():
            raise DataError(
                f"{directory}: contains a data set that was not simulated (no {SETTINGS_FILE}); "
                "choose another directory"
            )
        replace_file(path, (json.dumps(asdict(settings), indent=2) + "\n").encode())
        return
    try:
        stored = SimulationSettings(**json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise DataError(f"{path}: damaged ({error}); delete the directory and rerun") from error
    if stored != settings:
        raise ConfigError(
            f"{directory}: contains another simulation (frames={stored.frames} seed={stored.seed} "
            f"val_frames={stored.val_frames} format={stored.format}, requested "
            f"frames={settings.frames} seed={settings.seed} val_frames={settings.val_frames} "
            f"format={settings.format}); choose another directory or delete this one"
        )


def _frame_file(home: Path, folder: str, index: int) -> Path:
    return home / folder / f"{index:06d}{_FOLDERS[folder]}"


def _is_complete(home: Path, index: int) -> bool:
    """Return whether all files of a frame exist."""
    return all(_frame_file(home, folder, index).exists() for folder in _FOLDERS)


def _simulate_frame(home: Path, seed: int, index: int) -> None:
    """Simulate one frame and write its files, the label last."""
    layout, laser, lens = (np.random.default_rng([seed, index, part]) for part in range(3))
    scene = Scene.draw(layout)
    rig = CameraRig.draw(lens)
    caster = Caster(scene.vertices, scene.triangles)
    points = sweep(scene, caster, laser)
    view = render(scene, caster, rig, lens)
    annotations = annotate(scene, view, rig)
    replace_file(_frame_file(home, "velodyne", index), points.astype("<f4").tobytes())
    # The grain of the image leaves no repetitions: looking for them takes time and saves nothing.
    image = _png(view.image[..., ::-1], cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)
    replace_file(_frame_file(home, "image_2", index), image)
    semantic = _png(view.semantic, cv2.IMWRITE_PNG_STRATEGY_RLE)
    replace_file(_frame_file(home, SEMANTIC_FOLDER, index), semantic)
    replace_file(_frame_file(home, "calib", index), rig.kitti_text().encode())
    write_objects(
        _frame_file(home, "label_2", index), from_annotations(annotations, rig.calibration)
    )


def _png(pixels: np.ndarray, strategy: int) -> bytes:
    """Encode grey or BGR pixels as PNG; OpenCV's default compression level is the fast one."""
    _, encoded = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_STRATEGY, strategy])
    return bytes(encoded)


@contextmanager
def _parallel_map(
    task: Callable[[int], None], indices: Sequence[int], workers: int
) -> Iterator[Iterator[None]]:
    """Yield the iterator of a task's results for all indices, in this process or in several."""
    workers = min(workers, len(indices))
    if workers <= 1:
        yield map(task, indices)
        return
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        # This is a worker that imports its parent's script, which has no main guard. The parent
        # reports that in one line; multiprocessing would print a long traceback per worker.
        sys.exit(1)
    with ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), initializer=_start_worker
    ) as pool:
        try:
            yield pool.map(task, indices)
        except BrokenProcessPool:
            raise CurateError(
                "a simulation process was killed, or the script calls `simulate` outside of "
                '`if __name__ == "__main__":`; fix the script if necessary and rerun; finished '
                "frames are kept"
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)


def _start_worker() -> None:
    """Use one OpenCV thread per process, and exit when the parent process ends."""
    cv2.setNumThreads(1)
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _write_splits(directory: Path, settings: SimulationSettings) -> None:
    """Write the frame lists; this is done last, so they never contain a missing frame."""
    names = [f"{index:06d}\n" for index in range(settings.frames)]
    train = settings.frames - settings.val_frames
    for split, part in (("train", names[:train]), ("val", names[train:]), ("trainval", names)):
        replace_file(directory / "ImageSets" / f"{split}.txt", "".join(part).encode())
