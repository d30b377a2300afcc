"""The optimiser steps of a training, in one process or in each of several.

Several processes split every batch and average their gradients with torch's distributed data
parallel. The batch, the loss, the statistics of batch normalisations and the gradient are those of
one process, so the curves agree up to the rounding of sums.
"""

import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import astuple, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, distributed, nn

from curate.detectors.base import Student
from curate.detectors.precision import mixed_precision
from curate.detectors.whole_batch import batch_split, whole_batch_sum
from curate.errors import ModelError
from curate.training.batch_norm import normalise_whole_batches
from curate.training.batches import Batches
from curate.training.labels import WeightedLabels
from curate.training.loading import encoder_of, load_batches
from curate.training.moving_average import MovingAverage
from curate.training.settings import Statistic, TrainingSettings
from curate.training.snapshot import pack_snapshot, restore_snapshot

_WEIGHT_DECAY = 0.01
_MAX_GRADIENT_NORM = 10.0
# One cycle (Smith and Topin, 2018): the rate rises over this share of the steps, then falls.
_RISING_SHARE = 0.3
# Learning rate of the first step, as a share of the peak.
_FIRST_RATE_SHARE = 0.1
# The reported loss is the mean over this number of last steps.
_RECENT_STEPS = 50


@dataclass(frozen=True)
class TrainingJob:
    """What a process needs to train; it is pickled for other processes.

    Attributes:
        student: the student before the first step.
        samples: the training frames.
        settings: settings of the training.
        mark: `snapshot.fingerprint` of the training.
        snapshot: content of the snapshot to resume from; None to start from the beginning.
    """

    student: Student
    samples: WeightedLabels
    settings: TrainingSettings
    mark: str
    snapshot: bytes | None


def all_reduced(values: Tensor) -> Tensor:
    """Return the sum of a tensor over the processes of `torch.distributed`."""
    total = values.clone()
    distributed.all_reduce(total)
    return total


@dataclass(frozen=True)
class Place:
    """The place of a process among those that split the batches.

    Attributes:
        device: torch device of this process.
        rank: its number, from 0.
        processes: number of processes; more than one have joined a group of `torch.distributed`.
        total: returns the sum of a small tensor over the processes.
    """

    device: str
    rank: int = 0
    processes: int = 1
    total: Callable[[Tensor], Tensor] = all_reduced


@dataclass(frozen=True)
class Started:
    """The frames have been read.

    Attributes:
        step: number of steps that the snapshot has finished.
        bank: number of objects in the bank by category.
    """

    step: int
    bank: dict[str, int]


@dataclass(frozen=True)
class Stepped:
    """A step has ended with this loss."""

    step: int
    loss: float


@dataclass(frozen=True)
class Saved:
    """The state after a step, as the content of a snapshot file."""

    step: int
    snapshot: bytes


@dataclass(frozen=True)
class Trained:
    """The training has ended.

    Attributes:
        weights: state of the student's network, or of its moving average.
        loss: mean loss of the last steps.
        statistics: see `TrainingReport`.
    """

    weights: Mapping[str, Tensor]
    loss: float
    statistics: tuple[Statistic, ...]


Message = Started | Stepped | Saved | Trained
Report = Callable[[Message], None]
Loss = Callable[[Any, float], Mapping[str, Tensor]]


def run_steps(job: TrainingJob, place: Place, report: Report) -> None:
    """Train in this process, alone or as one of several.

    Args:
        job: what to train.
        place: the place of this process.
        report: called during the training; the last message is `Trained`. All processes report
            the same.

    Raises:
        DataError: if a frame cannot be read.
        ModelError: if the loss is not finite.
    """
    settings = job.settings
    torch.set_num_threads(settings.threads)
    encoder = encoder_of(job.student, settings)
    network = job.student.network.to(place.device)
    batches = Batches(job.samples, settings, place.rank, place.processes)
    average = _average_of(network, settings)
    networks = [network, average.network] if average else [network]
    optimizer = torch.optim.AdamW(
        network.parameters(), weight_decay=_WEIGHT_DECAY, betas=(0.9, 0.99)
    )
    scaler = torch.amp.GradScaler(
        torch.device(place.device).type, enabled=settings.precision == "float16"
    )
    state: dict[str, Any] = {"step": 0, "losses": [], "statistics": [], "scaler": {}}
    if job.snapshot:
        state = restore_snapshot(job.snapshot, networks, optimizer)
    report(Started(state["step"], {name: len(each) for name, each in batches.bank.objects.items()}))
    if state["scaler"]:
        scaler.load_state_dict(state["scaler"])
    losses = state["losses"]
    statistics = [Statistic(*each) for each in state["statistics"]]
    saved = time.monotonic()
    network.train()
    steps = range(state["step"], settings.steps)
    expected = settings.batch_size * batches.objects_per_frame
    loaded = load_batches(encoder, batches, steps, replace(settings, device=place.device))
    with _loss_of(job.student, place) as loss:
        for step, batch in zip(steps, loaded, strict=True):
            terms = partial(loss, batch, expected)
            values = _train_step(job, place, terms, optimizer, scaler, step)
            losses = [*losses[1 - _RECENT_STEPS :], _finite(float(values["loss"]), step)]
            if (step + 1) % settings.statistics_steps == 0 or step + 1 == settings.steps:
                statistics += [
                    Statistic(step + 1, name, float(value)) for name, value in values.items()
                ]
            if average:
                average.update(network)
            report(Stepped(step + 1, losses[-1]))
            if time.monotonic() - saved >= settings.snapshot_seconds:
                progress = {
                    "step": step + 1,
                    "losses": losses,
                    "statistics": list(map(astuple, statistics)),
                    "scaler": scaler.state_dict(),
                }
                content = pack_snapshot(job.mark, networks, optimizer, progress)
                report(Saved(step + 1, content))
                saved = time.monotonic()
    weights = {name: tensor.cpu() for name, tensor in networks[-1].state_dict().items()}
    report(Trained(weights, sum(losses) / len(losses), tuple(statistics)))


def _finite(loss: float, step: int) -> float:
    """Return the loss of a step.

    Raises:
        ModelError: if it is NaN or infinite, because all further steps would be too.
    """
    if not math.isfinite(loss):
        raise ModelError(
            f"the loss of step {step + 1} is {loss}: the training has diverged; lower "
            "train.learning_rate (train.round_learning_rate in rounds)"
        )
    return loss


def one_cycle(step: int, steps: int, peak: float) -> float:
    """Return the learning rate of a step: a cosine up to the peak, then a longer one to zero."""
    rising = max(1.0, _RISING_SHARE * steps)
    if step < rising:
        share = (1 - math.cos(math.pi * step / rising)) / 2
        return peak * (_FIRST_RATE_SHARE + (1 - _FIRST_RATE_SHARE) * share)
    return peak * (1 + math.cos(math.pi * (step - rising) / max(1.0, steps - rising))) / 2


def _average_of(network: nn.Module, settings: TrainingSettings) -> MovingAverage | None:
    """Return the moving average of the student, or None if the settings do not use one."""
    if settings.teacher == "student":
        return None
    return MovingAverage(network, settings.ema_decay, settings.steps)


class _SharedLoss(nn.Module):
    """The loss of a student as a module, which distributed data parallel needs."""

    def __init__(self, student: Student) -> None:
        super().__init__()
        self.network = student.network
        self._loss = student.loss

    def forward(self, batch: Any, expected_objects: float) -> dict[str, Tensor]:
        """Return the loss and its terms."""
        terms = dict(self._loss(batch, expected_objects))
        # Distributed data parallel waits for the gradient of every parameter, also of one that this
        # part of the batch does not need, such as those of a second stage without proposals.
        nothing = sum(each.sum() * 0 for each in self.network.parameters() if each.requires_grad)
        return terms | {"loss": terms["loss"] + nothing}


@contextmanager
def _loss_of(student: Student, place: Place) -> Iterator[Loss]:
    """Yield the loss; with several processes, gradients and statistics are those of all."""
    if place.processes == 1:
        yield student.loss
        return
    normalise_whole_batches(student.network)
    with warnings.catch_warnings():
        # Newer versions of torch prefer another argument, which older ones do not have.
        warnings.simplefilter("ignore", FutureWarning)
        shared = nn.parallel.DistributedDataParallel(
            _SharedLoss(student),
            broadcast_buffers=False,  # they are the same in all processes
        )
    shared.register_comm_hook(place.total, _total_gradient)
    with batch_split(place.total):
        yield shared


def _total_gradient(
    total: Callable[[Tensor], Tensor],
    bucket: distributed.GradBucket,  # type: ignore[name-defined]
) -> torch.futures.Future[Tensor]:
    """Return the sum of gradients over the processes: the gradient of the whole batch's loss."""
    done: torch.futures.Future[Tensor] = torch.futures.Future()
    done.set_result(total(bucket.buffer()))
    return done


def _train_step(
    job: TrainingJob,
    place: Place,
    loss: Callable[[], Mapping[str, Tensor]],
    optimizer: torch.optim.Optimizer,
    scaler: torch.amp.GradScaler,
    step: int,
) -> dict[str, float | Tensor]:
    """Run one optimiser step; return its statistics by name, for the whole batch."""
    settings = job.settings
    rate = one_cycle(step, settings.steps, settings.learning_rate)
    for group in optimizer.param_groups:
        group["lr"] = rate
    with (
        _torch_seeded([settings.seed, step, place.rank], place.device),
        mixed_precision(settings.precision, place.device),
    ):
        terms = loss()
    optimizer.zero_grad(set_to_none=True)
    torch.autograd.backward(scaler.scale(terms["loss"]))
    scaler.unscale_(optimizer)
    norm = nn.utils.clip_grad_norm_(job.student.network.parameters(), _MAX_GRADIENT_NORM)
    scaler.step(optimizer)
    scaler.update()
    totals = {name: term.detach() for name, term in terms.items()}
    if place.processes > 1:
        own = torch.stack([term.double().reshape(()) for term in totals.values()])
        totals = dict(zip(totals, whole_batch_sum(own), strict=True))
    return {**totals, "learning_rate": rate, "gradient_norm": norm}


@contextmanager
def _torch_seeded(seed: list[int], device: str) -> Iterator[None]:
    """Seed torch's global generators for a step, and restore their state afterwards.

    Dropout and sampling in a student do not accept a generator. Seeded per step, they draw the same
    numbers in a resumed training. Each process draws its own.
    """
    kind = torch.device(device).type
    numbered = kind in {"cuda", "xpu"}  # the generators of other devices cannot be stored
    devices = range(getattr(torch, kind).device_count()) if numbered else ()
    with torch.random.fork_rng(devices, device_type=kind if numbered else "cuda"):
        torch.manual_seed(int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]))
        yield
