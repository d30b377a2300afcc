"""Training of a detector on labeled frames and weighted pseudo-labels (Eqs. 6 and 10)."""

import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from curate.detectors.base import Student, TrainableDetector, choose_preset
from curate.detectors.devices import check_device
from curate.detectors.precision import mixed_precision
from curate.errors import ConfigError
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.training.batches import Batches
from curate.training.labels import WeightedLabels
from curate.training.loading import encoder_of, load_batches
from curate.training.moving_average import MovingAverage
from curate.training.settings import Statistic, TrainingReport, TrainingSettings
from curate.training.snapshot import fingerprint, load_snapshot, save_snapshot, snapshot_path

_log = logging.getLogger(__name__)

# Arguments: number of the step, number of steps, loss of the step.
Progress = Callable[[int, int, float], None]

_WEIGHT_DECAY = 0.01
_MAX_GRADIENT_NORM = 10.0
# One cycle (Smith and Topin, 2018): the rate rises over this share of the steps, then falls.
_RISING_SHARE = 0.3
# Learning rate of the first step, as a share of the peak.
_FIRST_RATE_SHARE = 0.1
# The reported loss is the mean over this number of last steps.
_RECENT_STEPS = 50


def train(
    detector: type[TrainableDetector],
    labels: StrPath,
    output: StrPath,
    settings: TrainingSettings,
    *,
    start: StrPath | None = None,
    read: Callable[[str], Frame] | None = None,
    progress: Progress | None = None,
) -> TrainingReport:
    """Train a detector and write the checkpoint of the student or of its moving average.

    A killed training resumes from its last snapshot when it is called again with the same
    arguments. It ends with the same weights as an uninterrupted one.

    Args:
        detector: class of the detector.
        labels: exported label file; it may have no unlabeled frames.
        output: the checkpoint to write.
        settings: see `TrainingSettings`.
        start: checkpoint to start from, such as the teacher; by default training starts from
            scratch.
        read: see `WeightedLabels`.
        progress: called after every step with the step, the number of steps and the loss.

    Raises:
        DataError: if the labels or a frame cannot be read.
        LeakageError: if the label file contains ground truth of unlabeled frames.
        ModelError: if the start checkpoint cannot be used.
        ConfigError: if the start checkpoint has another preset or other categories, the detector
            has no such preset or its student lacks a member, or the device or the precision cannot
            be used.
        CurateError: if a process that prepares batches is killed.
    """
    began = time.monotonic()
    labels, output = Path(labels), Path(output)
    start = None if start is None else Path(start)
    torch.set_num_threads(settings.threads)
    settings = replace(settings, preset=choose_preset(detector, settings.preset))
    samples = WeightedLabels(labels, read=read)
    student = _first_student(detector, settings, samples.categories, start)
    encoder = encoder_of(student, settings)
    check_device(settings.device)
    network = student.network.to(settings.device)
    batches = Batches(samples, settings)
    for category, objects in batches.bank.objects.items():
        if not objects:
            _log.warning("%s: no labeled %s to learn from", labels, category)
    optimizer = torch.optim.AdamW(
        network.parameters(), weight_decay=_WEIGHT_DECAY, betas=(0.9, 0.99)
    )
    scaler = torch.amp.GradScaler(
        torch.device(settings.device).type, enabled=settings.precision == "float16"
    )
    mark = fingerprint(detector, labels, settings, start)
    average = _average_of(network, settings)
    networks = [network, average.network] if average else [network]
    initial: dict[str, Any] = {"step": 0, "losses": [], "statistics": [], "scaler": {}}
    state = load_snapshot(output, mark, networks, optimizer) or initial
    resumed_at, losses = state["step"], state["losses"]
    statistics = [Statistic(*each) for each in state["statistics"]]
    if state["scaler"]:
        scaler.load_state_dict(state["scaler"])
    saved = time.monotonic()
    network.train()
    steps = range(resumed_at, settings.steps)
    expected = settings.batch_size * batches.objects_per_frame
    loaded = load_batches(encoder, batches, steps, settings)
    for step, batch in zip(steps, loaded, strict=True):
        values = _train_step(student, optimizer, scaler, batch, expected, step, settings)
        losses = [*losses[1 - _RECENT_STEPS :], float(values["loss"])]
        if (step + 1) % settings.statistics_steps == 0 or step + 1 == settings.steps:
            statistics += [
                Statistic(step + 1, name, float(value)) for name, value in values.items()
            ]
        if average:
            average.update(network)
        if progress:
            progress(step + 1, settings.steps, losses[-1])
        if time.monotonic() - saved >= settings.snapshot_seconds:
            state = {
                "step": step + 1,
                "losses": losses,
                "statistics": list(map(astuple, statistics)),
                "scaler": scaler.state_dict(),
            }
            save_snapshot(output, mark, networks, optimizer, state)
            saved = time.monotonic()
    student.save(output, networks[-1].state_dict())
    snapshot_path(output).unlink(missing_ok=True)
    return TrainingReport(
        checkpoint=output,
        steps=settings.steps,
        resumed_at=resumed_at,
        loss=sum(losses) / len(losses),
        seconds=time.monotonic() - began,
        labeled_frames=len(batches.labeled),
        unlabeled_frames=len(batches.unlabeled),
        bank={category: len(objects) for category, objects in batches.bank.objects.items()},
        statistics=tuple(statistics),
    )


def one_cycle(step: int, steps: int, peak: float) -> float:
    """Return the learning rate of a step: a cosine up to the peak, then a longer one to zero."""
    rising = max(1.0, _RISING_SHARE * steps)
    if step < rising:
        share = (1 - math.cos(math.pi * step / rising)) / 2
        return peak * (_FIRST_RATE_SHARE + (1 - _FIRST_RATE_SHARE) * share)
    return peak * (1 + math.cos(math.pi * (step - rising) / max(1.0, steps - rising))) / 2


def _average_of(network: torch.nn.Module, settings: TrainingSettings) -> MovingAverage | None:
    """Return the moving average of the student, or None if the settings do not use one."""
    if settings.teacher == "student":
        return None
    return MovingAverage(network, settings.ema_decay, settings.steps)


def _train_step(
    student: Student,
    optimizer: torch.optim.Optimizer,
    scaler: torch.amp.GradScaler,
    batch: Any,
    expected: float,
    step: int,
    settings: TrainingSettings,
) -> dict[str, float | torch.Tensor]:
    """Run one optimiser step; return its statistics by name."""
    rate = one_cycle(step, settings.steps, settings.learning_rate)
    for group in optimizer.param_groups:
        group["lr"] = rate
    with (
        _torch_seeded([settings.seed, step], settings.device),
        mixed_precision(settings.precision, settings.device),
    ):
        terms = student.loss(batch, expected)
    optimizer.zero_grad(set_to_none=True)
    torch.autograd.backward(scaler.scale(terms["loss"]))
    scaler.unscale_(optimizer)
    norm = torch.nn.utils.clip_grad_norm_(student.network.parameters(), _MAX_GRADIENT_NORM)
    scaler.step(optimizer)
    scaler.update()
    detached = {name: term.detach() for name, term in terms.items()}
    return {**detached, "learning_rate": rate, "gradient_norm": norm}


@contextmanager
def _torch_seeded(seed: list[int], device: str) -> Iterator[None]:
    """Seed torch's global generators for a step, and restore their state afterwards.

    Dropout and sampling in a student do not accept a generator. Seeded per step, they draw the same
    numbers in a resumed training.
    """
    kind = torch.device(device).type
    numbered = kind in {"cuda", "xpu"}  # the generators of other devices cannot be stored
    devices = range(getattr(torch, kind).device_count()) if numbered else ()
    with torch.random.fork_rng(devices, device_type=kind if numbered else "cuda"):
        torch.manual_seed(int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]))
        yield


def _first_student(
    detector: type[TrainableDetector],
    settings: TrainingSettings,
    categories: tuple[str, ...],
    start: Path | None,
) -> Student:
    """Return the student before the first step, on the CPU."""
    if start is None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            student = detector.new_student(settings.preset or "", categories)
    else:
        student = detector.load_student(start)
    expected = (*Student.__annotations__, *(name for name in vars(Student) if name[0] != "_"))
    missing = [name for name in expected if not hasattr(student, name)]
    if missing:
        raise ConfigError(
            f"{type(student).__module__}:{type(student).__qualname__} has no {', '.join(missing)}; "
            "see curate.detectors.base.Student"
        )
    if (student.preset, student.categories) != (settings.preset, categories):
        raise ConfigError(
            f"{start}: has preset {student.preset} and categories {', '.join(student.categories)}; "
            f"the training needs {settings.preset} and {', '.join(categories)}"
        )
    return student
