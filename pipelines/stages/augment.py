"""augment: the copies A(x) of a split as files, for a detector that runs elsewhere.

It is not a stage of the graph: it writes no rows. `detector.augmented` reads what the detector
found in the copies, see `pipelines.stages.copies`.
"""

import errno
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from curate.datasets.base import Dataset
from curate.datasets.copies import CopyWriter, copy_writer
from curate.datasets.manifest import Manifest, view_folder
from curate.errors import ConfigError, CurateError, DataError, error_prefix
from pipelines.assembly import fill_folder
from pipelines.engine.executors.base import FrameJob, FrameRows
from pipelines.engine.progress import Progress
from pipelines.engine.runner import open_executor
from pipelines.stages.copies import manifest_of
from pipelines.workspace.config import Config
from pipelines.workspace.workspace import Workspace, open_dataset

# On disk, a calibration and the names of the links of a copy.
_FILES_BYTES = 16 << 10


@dataclass(frozen=True)
class Shard:
    """The k-th of n parts of the frames, of about the same size."""

    number: int = 1
    total: int = 1

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Return the shard in a text such as 3/16.

        Raises:
            ConfigError: if it is not of this form.
        """
        number, slash, total = text.partition("/")
        if slash and number.isdecimal() and total.isdecimal() and 1 <= int(number) <= int(total):
            return cls(int(number), int(total))
        raise ConfigError(
            f"--shard {text}: write the number of the part and of all parts, such as 3/16"
        )

    def of(self, frames: Sequence[str]) -> Sequence[str]:
        """Return the frames of this part."""
        return frames[self.number - 1 :: self.total]


@dataclass(frozen=True)
class PlannedCopies:
    """What is to be written.

    Attributes:
        folder: the folder of the copies.
        manifest: its manifest.
        frames: the frames of the shard.
        missing: those of them that have not all copies.
        written_bytes: expected size of the missing copies on disk.
        free_bytes: free space on the disk.
    """

    folder: Path
    manifest: Manifest
    frames: Sequence[str]
    missing: Sequence[str]
    written_bytes: int
    free_bytes: int


@dataclass
class Result:
    """What a run of `augment` did.

    Attributes:
        folder: the folder of the copies.
        split: split of the frames.
        round: number of the round.
        views: the data sets of the copies.
        kind: their kind.
        frames: number of frames of the shard.
        written: number of frames with new copies.
        kept: number of frames with copies from before.
        errors: (frame name, error) of the failed frames.
    """

    folder: str
    split: str
    round: int
    views: Sequence[str]
    kind: str
    frames: int
    kept: int
    written: int = 0
    errors: list[tuple[str, str]] = field(default_factory=list)


class WriteCopies:
    """Writes all copies of a frame, in the process of an executor."""

    def __init__(self, config: Config, folder: Path, manifest: Manifest) -> None:
        self._config = config
        self._folder = folder
        self._manifest = manifest

    def open(self) -> None:
        """Open the data set."""
        dataset = open_dataset(self._config)
        self._writers = writers(dataset, self._folder, self._manifest)

    def __call__(self, job: FrameJob) -> FrameRows:
        """Write the missing copies of a frame."""
        with error_prefix(f"frame {job.frame}"):
            for writer in self._writers:
                if not writer.is_written(job.frame):
                    writer.write(job.frame)
        return {}


def writers(dataset: Dataset, folder: Path, manifest: Manifest) -> list[CopyWriter]:
    """Return the writer of each view."""
    return [
        copy_writer(
            dataset,
            view_folder(view, folder),
            {name: views[view] for name, views in manifest.frames.items()},
            camera_view=manifest.camera_view,
        )
        for view in range(manifest.drawn.views)
    ]


def plan(
    workspace: Workspace,
    folder: Path,
    split: str,
    round_number: int,
    shard: Shard,
    *,
    camera_view: bool = False,
) -> PlannedCopies:
    """Return what is to be written; nothing is written.

    Raises:
        ConfigError: if the split has no frames, or the folder is in the data set or cannot be
            created.
        DataError: if the folder contains something else, or the disk is too small.
    """
    if not workspace.frames(split):
        raise ConfigError(f"--split {split}: the workspace has no {split} frames")
    folder = fill_folder(folder, round_number, split)
    _check_place(workspace, folder)
    manifest = manifest_of(workspace, round_number, split, camera_view=camera_view)
    manifest.check_place(folder)
    frames = shard.of(list(manifest.frames))
    views = writers(workspace.dataset, folder, manifest)
    missing, size = [], 0
    for frame in frames:
        count = sum(not writer.is_written(frame) for writer in views)
        if count:
            missing.append(frame)
            size += count * (_FILES_BYTES + _size(workspace.dataset.files(frame).points))
    free = shutil.disk_usage(_existing(folder)).free
    if size > free:
        raise DataError(
            f"{folder}: the copies need about {_gigabytes(size)}, but the disk has only "
            f"{_gigabytes(free)} left; choose another disk, or write a part with --shard"
        )
    return PlannedCopies(folder, manifest, frames, missing, size, free)


def write(workspace: Workspace, planned: PlannedCopies, progress: Progress) -> Result:
    """Write the missing copies of a plan.

    Raises:
        DataError: if the files that all copies share cannot be written, or the disk is full.
    """
    folder, manifest = planned.folder, planned.manifest
    manifest.write(folder)
    views = writers(workspace.dataset, folder, manifest)
    for writer in views:
        writer.prepare()
    result = Result(
        str(folder),
        manifest.split,
        manifest.drawn.round_number,
        [str(view_folder(view, folder)) for view in range(len(views))],
        manifest.copies_kind,
        len(planned.frames),
        len(planned.frames) - len(planned.missing),
    )
    function = WriteCopies(workspace.config, folder, manifest)
    jobs = [FrameJob(number, name) for number, name in enumerate(planned.missing)]
    total = len(planned.missing)
    with open_executor(workspace) as work, progress.track("augment", total) as advance:
        for outcome in work.map(function, iter(jobs)):
            if outcome.error is None:
                result.written += 1
            elif os.strerror(errno.ENOSPC) in outcome.error:
                raise CurateError(
                    f"{folder}: the disk is full; make room and rerun, finished copies are kept"
                )
            else:
                result.errors.append((outcome.job.title, outcome.error))
            advance(1, f"{len(result.errors)} failed" if result.errors else "")
    return result


def _check_place(workspace: Workspace, folder: Path) -> None:
    """Raise ConfigError if a folder is in the data set, or cannot be created."""
    path, data = folder.resolve(), workspace.config.dataset.root.resolve()
    # A workspace in the data set is the user's choice already.
    workspaces = [workspace.root] if workspace.root.is_relative_to(data) else []
    if path.is_relative_to(data) and not any(map(path.is_relative_to, workspaces)):
        raise ConfigError(
            f"{folder}: is in the data set {data}, where the copies could be read as frames; "
            "choose a folder outside"
        )
    existing = _existing(folder)
    if not existing.is_dir():
        raise ConfigError(f"{folder}: {existing} is not a folder; choose another place")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise ConfigError(f"{folder}: {existing} cannot be written to; choose another place")


def _existing(folder: Path) -> Path:
    """Return the folder, or the nearest path above it that exists."""
    return next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:  # the frame fails when it is written
        return 0


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:.1f} GB"
