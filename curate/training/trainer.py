"""Trains the pillar detector on labeled frames and weighted pseudo-labels (Eqs. 6 and 10)."""

import logging
import math
import time
from collections.abc import Callable
from pathlib import Path

import torch

from curate.detectors.pillars.checkpoint import load_checkpoint, save_checkpoint
from curate.detectors.pillars.network import PillarNetwork, checkpoint_of, network_of
from curate.detectors.pillars.presets import preset_named
from curate.errors import ConfigError, ModelError, first_line
from curate.frames import Frame
from curate.training.batches import Batches
from curate.training.labels import WeightedLabels
from curate.training.loss import weighted_loss
from curate.training.moving_average import MovingAverage
from curate.training.settings import TrainingReport, TrainingSettings
from curate.training.snapshot import fingerprint, load_snapshot, save_snapshot, snapshot_path

_log = logging.getLogger(__name__)

# Step, steps, loss of the step.
Progress = Callable[[int, int, float], None]

_WEIGHT_DECAY = 0.01
_LARGEST_GRADIENT = 10.0
# One cycle (Smith and Topin, 2018): the rate rises over this share of the steps, then falls.
_RISING_SHARE = 0.3
_FIRST_RATE_SHARE = 0.1
# The reported loss is the mean of so many last steps.
_RECENT_STEPS = 50


def train(
    labels: Path,
    output: Path,
    settings: TrainingSettings,
    *,
    start: Path | None = None,
    read: Callable[[str], Frame] | None = None,
    progress: Progress | None = None,
) -> TrainingReport:
    """Trains a detector and writes its checkpoint and ONNX graph, or those of its moving average.

    A killed training, called again with the same arguments, goes on from its last snapshot and ends
    with the weights that it would have had.

    Args:
        labels: exported label file; its unlabeled frames may be none.
        output: the checkpoint to write, NAME.safetensors; its graph becomes NAME.onnx.
        settings: see `TrainingSettings`.
        start: checkpoint to begin from, such as the teacher; from scratch without.
        read: see `WeightedLabels`.
        progress: called after every step with the step, the number of steps and the loss.

    Raises:
        DataError: the labels or a frame cannot be read.
        LeakageError: ground truth of unlabeled frames is among the labels.
        ModelError: the start cannot be used.
        ConfigError: the start is of another preset or other categories, or there is no such device.
    """
    began = time.monotonic()
    torch.set_num_threads(settings.threads)
    samples = WeightedLabels(labels, read=read)
    network = _first_network(settings, samples.categories, start)
    batches = Batches(samples, settings)
    for category, objects in batches.bank.objects.items():
        if not objects:
            _log.warning("%s: no labeled %s to learn from", labels, category)
    optimizer = torch.optim.AdamW(
        network.parameters(), weight_decay=_WEIGHT_DECAY, betas=(0.9, 0.99)
    )
    mark = fingerprint(labels, settings, start)
    average = _average_of(network, settings)
    networks = [network, average.network] if average else [network]
    state = load_snapshot(output, mark, networks, optimizer) or {"step": 0, "losses": []}
    resumed_at, losses = state["step"], state["losses"]
    saved = time.monotonic()
    network.train()
    for step in range(resumed_at, settings.steps):
        losses = [*losses[1 - _RECENT_STEPS :], _learn(network, optimizer, batches, step, settings)]
        if average:
            average.follow(network)
        if progress:
            progress(step + 1, settings.steps, losses[-1])
        if time.monotonic() - saved >= settings.snapshot_seconds:
            state = {"step": step + 1, "losses": losses}
            save_snapshot(output, mark, networks, optimizer, state)
            saved = time.monotonic()
    save_checkpoint(output, checkpoint_of(networks[-1], samples.categories))
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
    )


def one_cycle(step: int, steps: int, peak: float) -> float:
    """The learning rate of a step: a cosine up to the peak, and a longer one down to zero."""
    rising = max(1.0, _RISING_SHARE * steps)
    if step < rising:
        share = (1 - math.cos(math.pi * step / rising)) / 2
        return peak * (_FIRST_RATE_SHARE + (1 - _FIRST_RATE_SHARE) * share)
    return peak * (1 + math.cos(math.pi * (step - rising) / max(1.0, steps - rising))) / 2


def _average_of(network: PillarNetwork, settings: TrainingSettings) -> MovingAverage | None:
    """What follows the student, if its average is to be left."""
    if settings.teacher == "student":
        return None
    return MovingAverage(network, settings.ema_decay, settings.steps)


def _learn(
    network: PillarNetwork,
    optimizer: torch.optim.Optimizer,
    batches: Batches,
    step: int,
    settings: TrainingSettings,
) -> float:
    """One step; gives its loss."""
    for group in optimizer.param_groups:
        group["lr"] = one_cycle(step, settings.steps, settings.learning_rate)
    batch = batches[step]
    answers = network(batch.features, batch.slots, batch.frames)
    expected = settings.batch_size * batches.objects_per_frame
    loss = weighted_loss(answers, batch.targets, network.preset, expected)
    optimizer.zero_grad(set_to_none=True)
    torch.autograd.backward(loss)
    torch.nn.utils.clip_grad_norm_(network.parameters(), _LARGEST_GRADIENT)
    optimizer.step()
    return float(loss.detach())


def _first_network(
    settings: TrainingSettings, categories: tuple[str, ...], start: Path | None
) -> PillarNetwork:
    """The network before the first step, on the device of the training."""
    if start is None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            network = PillarNetwork(preset_named(settings.preset), len(categories))
    else:
        checkpoint = load_checkpoint(start)
        if (checkpoint.preset.name, checkpoint.categories) != (settings.preset, categories):
            raise ConfigError(
                f"{start}: is a {checkpoint.preset.name} detector of "
                f"{', '.join(checkpoint.categories)}; the training is for {settings.preset} and "
                f"{', '.join(categories)}"
            )
        try:
            network = network_of(checkpoint)
        except ModelError as error:
            raise ModelError(f"{start}: {error}") from None
    try:
        return network.to(settings.device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(
            f"device {settings.device!r} cannot be used: {first_line(error)}"
        ) from None
