"""Training of a detector on labeled frames and weighted pseudo-labels (Eqs. 6 and 10)."""

import inspect
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from curate.detectors.base import IgnoredRegions, Student, TrainableDetector, choose_preset
from curate.detectors.devices import check_device
from curate.errors import ConfigError, CurateError, ProcessDied
from curate.files.atomic import replace_file
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.training.labels import WeightedLabels
from curate.training.loop import (
    Message,
    Place,
    Saved,
    Started,
    Stepped,
    Trained,
    TrainingJob,
    run_steps,
)
from curate.training.processes import Launch, run_in_processes
from curate.training.settings import TrainingReport, TrainingSettings
from curate.training.snapshot import find_snapshot, fingerprint, snapshot_path
from curate.warnings_once import NOTES, warn_once

_log = logging.getLogger(__name__)
_notes = logging.getLogger(NOTES)

# Arguments: number of the step, number of steps, loss of the step.
Progress = Callable[[int, int, float], None]

# The training ends after this many killed processes without a new snapshot in between.
_DEATHS = 4


def train(
    detector: type[TrainableDetector],
    labels: StrPath,
    output: StrPath,
    settings: TrainingSettings,
    *,
    start: StrPath | None = None,
    options: Mapping[str, Any] | None = None,
    read: Callable[[str], Frame] | None = None,
    progress: Progress | None = None,
    launch: Launch = run_in_processes,
    regions: IgnoredRegions | None = None,
) -> TrainingReport:
    """Train a detector and write the checkpoint of the student or of its moving average.

    A killed training resumes from its last snapshot when it is called again with the same
    arguments. It ends with the same weights as an uninterrupted one.

    With `settings.processes` above 1, other processes train and this one writes. If one of them is
    killed, all resume from the last snapshot. They are started with `multiprocessing`, so a script
    calls this function below `if __name__ == "__main__":`.

    Args:
        detector: class of the detector.
        labels: exported label file; it may have no unlabeled frames.
        output: the checkpoint to write.
        settings: see `TrainingSettings`.
        start: checkpoint to start from, such as the teacher; by default training starts from
            scratch.
        options: the detector's options; the ones that its `load_student` has are passed to it.
        read: see `WeightedLabels`.
        progress: called after every step with the step, the number of steps and the loss.
        launch: starts the processes if there are several; by default on this machine.
        regions: regions of unlabeled frames to ignore, see `WeightedLabels`.

    Raises:
        DataError: if the labels or a frame cannot be read.
        LeakageError: if the label file contains ground truth of unlabeled frames.
        ModelError: if the start checkpoint cannot be used.
        ConfigError: if the start checkpoint has another preset or other categories, the detector
            has no such preset or its student lacks a member, or the device or the precision cannot
            be used.
        CurateError: if a process that prepares batches is killed, or processes are killed again and
            again without a new snapshot in between.
    """
    began = time.monotonic()
    labels, output = Path(labels), Path(output)
    start = None if start is None else Path(start)
    settings = replace(settings, preset=choose_preset(detector, settings.preset))
    samples = WeightedLabels(labels, read=read, regions=regions)
    processes = _useful_processes(settings, samples)
    options = _options_of_start(detector, start, options or {})
    student = _first_student(detector, settings, samples.categories, start, options)
    check_device(settings.device)
    mark = fingerprint(detector, labels, settings, start, options, regions)
    writer = _Writer(labels, output, settings.steps, progress)
    while True:
        snapshot = find_snapshot(output, mark)
        job = TrainingJob(student, samples, settings, mark, snapshot)
        try:
            if processes == 1:
                run_steps(job, Place(settings.device), writer.receive)
            else:
                launch(job, processes, writer.receive)
            break
        except ProcessDied as death:
            writer.record(death)
    trained, started = writer.trained, writer.started
    student.save(output, trained.weights)
    snapshot_path(output).unlink(missing_ok=True)
    return TrainingReport(
        checkpoint=output,
        steps=settings.steps,
        resumed_at=started.step,
        loss=trained.loss,
        seconds=time.monotonic() - began,
        labeled_frames=int(np.count_nonzero(samples.labeled)),
        unlabeled_frames=int(np.count_nonzero(~samples.labeled)),
        bank=started.bank,
        statistics=trained.statistics,
    )


class _Writer:
    """Writes what the training reports, and counts how often its processes were killed.

    Attributes:
        started: the first report of this training.
        trained: its last report.
    """

    started: Started
    trained: Trained

    def __init__(self, labels: Path, output: Path, steps: int, progress: Progress | None) -> None:
        self._labels, self._output, self._steps = labels, output, steps
        self._progress = progress
        self._deaths = 0
        self._saved_step = 0

    def receive(self, message: Message) -> None:
        """Show the progress, write a snapshot, or keep the result."""
        if isinstance(message, Started) and not hasattr(self, "started"):
            self.started, self._saved_step = message, message.step
            if message.step:
                _notes.info(
                    "%s: the training resumes from step %d of %d",
                    *(self._output.stem, message.step, self._steps),
                )
            for category, objects in message.bank.items():
                if not objects:
                    _log.warning("%s: no labeled %s to learn from", self._labels, category)
        elif isinstance(message, Stepped) and self._progress:
            self._progress(message.step, self._steps, message.loss)
        elif isinstance(message, Saved):
            replace_file(snapshot_path(self._output), message.snapshot)
            self._deaths, self._saved_step = 0, message.step
        elif isinstance(message, Trained):
            self.trained = message

    def record(self, death: ProcessDied) -> None:
        """Count a death and report it.

        Raises:
            CurateError: if there were too many since the last snapshot.
        """
        self._deaths += 1
        if self._deaths == _DEATHS:
            raise CurateError(
                f"{death}; this happened {_DEATHS} times since step {self._saved_step}, so the "
                "training ends; rerun with fewer processes (train.processes), it resumes there"
            ) from death
        _log.warning("%s; the training resumes from step %d", death, self._saved_step)


def _useful_processes(settings: TrainingSettings, samples: WeightedLabels) -> int:
    """Return the number of processes that have a frame in every step."""
    unlabeled = 0 if samples.labeled.all() else settings.unlabeled_batch_size
    frames = settings.batch_size + unlabeled
    if settings.processes > frames:
        warn_once(
            f"{min(settings.processes, frames)} of {settings.processes} training processes are "
            f"used: a step has {frames} frames (train.batch_size, train.unlabeled_batch_size)"
        )
    return min(settings.processes, frames)


def _options_of_start(
    detector: type[TrainableDetector], start: Path | None, options: Mapping[str, Any]
) -> Mapping[str, Any]:
    """Return the options that the start checkpoint is loaded with; without one there are none."""
    if start is None:
        return {}
    accepted = inspect.signature(detector.load_student).parameters
    return {name: value for name, value in options.items() if name in accepted}


def _first_student(
    detector: type[TrainableDetector],
    settings: TrainingSettings,
    categories: tuple[str, ...],
    start: Path | None,
    options: Mapping[str, Any],
) -> Student:
    """Return the student before the first step, on the CPU."""
    if start is None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            student = detector.new_student(settings.preset or "", categories)
    else:
        student = detector.load_student(start, **options)
    expected = (*Student.__annotations__, *(name for name in vars(Student) if name[0] != "_"))
    missing = [name for name in expected if not hasattr(student, name)]
    if missing:
        raise ConfigError(
            f"{type(student).__module__}:{type(student).__qualname__} has no {', '.join(missing)}; "
            "see curate.detectors.base.Student"
        )
    preset = student.preset or settings.preset
    if (preset, student.categories) != (settings.preset, categories):
        raise ConfigError(
            f"{start}: has preset {preset} and categories {', '.join(student.categories)}; "
            f"the training needs {settings.preset} and {', '.join(categories)}"
        )
    return student
