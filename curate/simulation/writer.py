"""Writer of simulated LiDAR-camera data sets: single frames in KITTI's layout, or sequences.

Sequences are written as a plain folder with dataset.toml, times and poses. Frame i depends only on
(seed, i), or on (seed, sequence, number, length of the sequence), so frames are simulated in
parallel. Each file is written atomically, and the label last. A frame with all files is complete;
after a kill, the next run resumes with the missing frames.
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
from functools import lru_cache, partial
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
from curate.simulation.motion import RATE_HZ, World
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
_POSES, _TIMES = "poses", "times.txt"
_DESCRIPTION = f"""\
# Simulated sequences: frames are named SEQUENCE_NUMBER, {RATE_HZ:g} per second.
points = "velodyne"
images = "image_2"
labels = "label_2"
splits = "ImageSets"
calibration = "calib"
sequence_separator = "_"
poses = "{_POSES}"
times = "{_TIMES}"
"""


@dataclass(frozen=True)
class SimulationSettings:
    """The settings that determine a simulated data set; stored in simulation.json."""

    format: int
    seed: int
    frames: int
    val_frames: int
    sequences: int = 0

    @property
    def length(self) -> int:
        """Number of frames of a sequence; 0 without sequences."""
        return self.frames // self.sequences if self.sequences else 0

    def name(self, index: int) -> str:
        """Return the name of a frame."""
        if not self.sequences:
            return f"{index:06d}"
        return f"{index // self.length:04d}_{index % self.length:06d}"

    def stored(self) -> dict[str, int]:
        """Return the content of simulation.json; single frames have no key `sequences`."""
        return {key: value for key, value in asdict(self).items() if key != "sequences" or value}


@dataclass(frozen=True)
class _Home:
    """The folder of a simulated data set, with the files of its frames."""

    directory: Path
    settings: SimulationSettings

    @property
    def folder(self) -> Path:
        """The folder that contains a folder for each kind of file."""
        return self.directory if self.settings.sequences else self.directory / "training"

    def file(self, folder: str, index: int) -> Path:
        """Return the path of a file of a frame."""
        suffix = _FOLDERS.get(folder, ".txt")
        return self.folder / folder / f"{self.settings.name(index)}{suffix}"

    def is_complete(self, index: int) -> bool:
        """Return whether all files of a frame exist."""
        folders = (*_FOLDERS, *((_POSES,) if self.settings.sequences else ()))
        return all(self.file(folder, index).exists() for folder in folders)


def simulate(
    directory: StrPath,
    frames: int,
    seed: int,
    *,
    val_frames: int | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    sequences: int | None = None,
) -> None:
    """Write a simulated data set in KITTI's layout, or of sequences; existing frames are kept.

    A script that calls this function with more than one worker must do so below
    `if __name__ == "__main__":`, because each worker process imports the script.

    Args:
        directory: the root folder, where training/{velodyne,image_2,semantic_2,calib,label_2} and
            ImageSets/{train,val,trainval}.txt are written; of sequences, the first folders lie in
            the root itself, with poses, times.txt and dataset.toml.
        frames: number of frames.
        seed: seed of all frames; the number of workers does not change them.
        val_frames: number of frames at the end that form the split val; a quarter by default.
        workers: number of processes; one per core by default.
        progress: called with (frames done, frames).
        sequences: number of sequences of equal length, in which the vehicle and the objects move;
            each split has whole sequences. None for single frames.

    Raises:
        CurateError: if a worker was killed, or the script has no main guard.
        ConfigError: if a number is out of range, or the directory contains another simulation.
        DataError: if the directory contains other data or cannot be written, or its simulation.json
            is damaged.
    """
    directory = Path(directory)
    settings = _settings(frames, seed, val_frames, sequences)
    if workers is not None and workers < 1:
        raise ConfigError(f"workers must be at least 1, not {workers}")
    try:
        _check_settings_file(directory, settings)
        _simulate_missing(_Home(directory, settings), workers or os.cpu_count() or 1, progress)
        _write_splits(directory, settings)
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"{directory}: cannot be written: {reason}") from error


def _simulate_missing(
    home: _Home, workers: int, progress: Callable[[int, int], None] | None
) -> None:
    """Simulate the frames that are not complete."""
    for leftover in home.folder.glob("*/.*.partial"):  # from a run that was killed
        leftover.unlink()
    frames = home.settings.frames
    missing = [index for index in range(frames) if not home.is_complete(index)]
    done = frames - len(missing)
    if progress:
        progress(done, frames)
    with _parallel_map(partial(_simulate_frame, home), missing, workers) as results:
        for _ in results:
            done += 1
            if progress:
                progress(done, frames)
    _log.info("%s: %d simulated frames, %d of them new", home.folder, frames, len(missing))


def _settings(
    frames: int, seed: int, val_frames: int | None, sequences: int | None
) -> SimulationSettings:
    """Return the settings after checking them."""
    whole = 1 if sequences is None else _sequence_length(frames, sequences)
    val = frames // 4 // whole * whole if val_frames is None else val_frames
    if not 1 <= frames <= 999_999:
        raise ConfigError(f"frames must be 1 to 999999, not {frames}")
    if seed < 0:
        raise ConfigError(f"seed must be at least 0, not {seed}")
    if not 0 <= val < frames:
        raise ConfigError(f"val_frames must be 0 to {frames - 1} of {frames} frames, not {val}")
    if val % whole:
        raise ConfigError(
            f"val_frames must be a multiple of the {whole} frames of a sequence, not {val}"
        )
    return SimulationSettings(_FORMAT, seed, frames, val, sequences or 0)


def _sequence_length(frames: int, sequences: int) -> int:
    """Return the number of frames of each sequence."""
    if not 1 <= sequences <= frames:
        raise ConfigError(f"sequences must be 1 to {frames}, the number of frames, not {sequences}")
    if frames % sequences:
        raise ConfigError(
            f"{frames} frames are not divisible into {sequences} sequences of equal length; "
            f"choose {frames // sequences * sequences} frames, for example"
        )
    return frames // sequences


def _check_settings_file(directory: Path, settings: SimulationSettings) -> None:
    """Write simulation.json, or check that an existing one has the same settings."""
    path = directory / SETTINGS_FILE
    if not path.exists():
        if (directory / "training").exists() or (directory / "dataset.toml").exists():
            raise DataError(
                f"{directory}: contains a data set that was not simulated (no {SETTINGS_FILE}); "
                "choose another directory"
            )
        replace_file(path, (json.dumps(settings.stored(), indent=2) + "\n").encode())
        return
    try:
        stored = SimulationSettings(**json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise DataError(f"{path}: damaged ({error}); delete the directory and rerun") from error
    if stored != settings:
        raise ConfigError(
            f"{directory}: contains another simulation ({_described(stored)}, requested "
            f"{_described(settings)}); choose another directory or delete this one"
        )


def _described(settings: SimulationSettings) -> str:
    """Return the settings for a message."""
    order = ("frames", "seed", "val_frames", "sequences", "format")
    values = settings.stored()
    return " ".join(f"{key}={values[key]}" for key in order if key in values)


def _simulate_frame(home: _Home, index: int) -> None:
    """Simulate one frame and write its files, the label last."""
    seed, length = home.settings.seed, home.settings.length
    if length:
        sequence, number = divmod(index, length)
        laser = np.random.default_rng([seed, sequence, 1, number + 1])
        lens = np.random.default_rng([seed, sequence, 2])  # one camera and one light per sequence
        world = _world(seed, sequence, length)
        scene = world.scene(number / RATE_HZ)
        pose = " ".join(map(repr, world.pose(number / RATE_HZ).ravel().tolist()))
        replace_file(home.file(_POSES, index), f"{pose}\n".encode())
    else:
        layout, laser, lens = (np.random.default_rng([seed, index, part]) for part in range(3))
        scene = Scene.draw(layout)
    rig = CameraRig.draw(lens)
    caster = Caster(scene.vertices, scene.triangles)
    points = sweep(scene, caster, laser)
    view = render(scene, caster, rig, lens)
    annotations = annotate(scene, view, rig)
    replace_file(home.file("velodyne", index), points.astype("<f4").tobytes())
    # The grain of the image leaves no repetitions: looking for them takes time and saves nothing.
    image = _png(view.image[..., ::-1], cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)
    replace_file(home.file("image_2", index), image)
    semantic = _png(view.semantic, cv2.IMWRITE_PNG_STRATEGY_RLE)
    replace_file(home.file(SEMANTIC_FOLDER, index), semantic)
    replace_file(home.file("calib", index), rig.kitti_text().encode())
    write_objects(home.file("label_2", index), from_annotations(annotations, rig.calibration))


@lru_cache(maxsize=2)
def _world(seed: int, sequence: int, length: int) -> World:
    """Return the moving scene of a sequence."""
    layout, motion = (np.random.default_rng([seed, sequence, part]) for part in (0, 3))
    return World.draw(layout, motion, np.arange(length) / RATE_HZ)


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
    """Write the frame lists; this is done last, so they never contain a missing frame.

    Of sequences, dataset.toml and the times come before, so that the lists are complete with them.
    """
    if settings.sequences:
        times = [
            f"{settings.name(index)} {index % settings.length / RATE_HZ:.1f}\n"
            for index in range(settings.frames)
        ]
        replace_file(directory / _TIMES, "".join(times).encode())
        replace_file(directory / "dataset.toml", _DESCRIPTION.encode())
    names = [f"{settings.name(index)}\n" for index in range(settings.frames)]
    train = settings.frames - settings.val_frames
    for split, part in (("train", names[:train]), ("val", names[train:]), ("trainval", names)):
        replace_file(directory / "ImageSets" / f"{split}.txt", "".join(part).encode())
