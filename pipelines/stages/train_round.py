"""train-round: train the student from the exported labels and the teacher."""

from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection

from curate.datasets.base import Dataset
from curate.detectors.base import IgnoredRegions
from curate.detectors.devices import AUTO, choose_device
from curate.detectors.precision import FLOAT32, mixed_precision
from curate.errors import ConfigError, error_prefix
from curate.files.onnx_providers import CPU
from curate.frames import Frame
from db import bulk
from pipelines.assembly import (
    check_labels_format,
    check_policy,
    check_training_options,
    open_policy,
    trainable_detector,
    trained_detector,
    trainer_command,
)
from pipelines.engine.executors.machine import affordable_workers, usable_cores
from pipelines.engine.progress import Progress, as_total
from pipelines.engine.rounds import register_checkpoint
from pipelines.engine.stage import Product, RoundContext, RoundJob, Settings
from pipelines.stages import export
from pipelines.stages.external_trainer import train_externally
from pipelines.stages.methods import Method, method_of, zero_weight_of
from pipelines.stages.propose import check_proposable, propose, proposed_regions
from pipelines.stages.vanished import check_labels
from pipelines.workspace.config import Config, TrainSection
from pipelines.workspace.workspace import Workspace, open_dataset

if TYPE_CHECKING:
    from collections.abc import Sequence

    from curate.training.settings import Statistic, TrainingReport, TrainingSettings

MOST_LOADERS = 8


def settings(workspace: Workspace, context: RoundContext, policy: str) -> Settings:
    """Return what a student depends on besides teacher and labels."""
    section = workspace.config.train
    if section.command is not None:
        return {"command": section.command, "labels_format": section.labels_format}
    method, trainable = method_of(workspace.config, policy), trainable_detector(workspace.config)
    return {
        **section.model_dump(
            mode="json",
            exclude={
                "pretrain_steps",
                "learning_rate",
                "processes",
                "threads",
                "loaders",
                "ema_decay",
                "command",
                "labels_format",
                "statistics_steps",
                *unset_precision(section),
            },
        ),
        "preset": trainable and trainable.preset,
        "teacher": method.teacher,
        "zero_weight": zero_weight_of(workspace.config, policy),
        "ema_decay": section.ema_decay if method.teacher == "ema" else None,
        "seed": context.seed,
        "device": AUTO,  # a student is kept, wherever it was trained
        "detector": workspace.config.detector.name,
        "checkpoint": trainable and trainable.detector.checkpoint_version,
    }


def unset_precision(section: TrainSection) -> tuple[str, ...]:
    """Return the keys of newer settings with their defaults: results from before stay valid."""
    unset = {
        "precision": section.precision == FLOAT32,
        "ignore_proposals": not section.ignore_proposals,
    }
    return tuple(name for name, is_default in unset.items() if is_default)


def loaders(section: TrainSection, device: str) -> int:
    """Return how many processes prepare the batches of a training on a device."""
    if section.loaders != "auto":
        return section.loaders
    spare = min(MOST_LOADERS, usable_cores() - 1)
    return affordable_workers(spare) if device != CPU.name and spare else 0


def file(workspace: Workspace, context: RoundContext, policy: str) -> Path:
    """Return the path of the next teacher's checkpoint: the student, or its averaged weights.

    The suffix is that of the user's file, because a detector may choose the format by it.
    """
    supplied = workspace.config.detector.path
    trainable = trainable_detector(workspace.config)
    suffix = supplied.suffix if supplied else ""
    if trainable:
        suffix = trainable.detector.checkpoint_suffix
    name = f"round-{context.number:02d}-{policy}{suffix}"
    return workspace.root / "checkpoints" / name


def check(workspace: Workspace, policy: str) -> None:
    """Check the policy, and the settings of curate's trainer or of the user's.

    Raises:
        ConfigError: if the policy or the label format cannot be used, the trainer does not have a
            setting, or its command cannot be started.
    """
    config = workspace.config
    check_policy(config, policy)
    if config.train.ignore_proposals:
        check_proposable(workspace)
        if config.train.command is not None:
            raise ConfigError(
                "train.ignore_proposals is for curate's own trainer; remove it, or train.command"
            )
    if config.train.command is not None:
        check_labels_format(config, workspace.dataset)
        trainer_command(config.train.command, workspace.root)
    elif trainable_detector(config):
        section, method = config.train, method_of(config, policy)
        training_settings(workspace, section.round_steps, section.round_learning_rate, 1, method)


def run(workspace: Workspace, job: RoundJob, progress: Progress) -> Product:
    """Train the student, by curate or by the user's command.

    Raises:
        ConfigError: if curate cannot train the configured detector, or the command is wrong.
        TrainerFailed: if the command fails, or does not write a checkpoint.
        LabelsVanished: if the round has no labels.
    """
    path = file(workspace, job.context, job.policy)
    trainable = trainable_detector(workspace.config)
    check_labels(workspace, job.context.number, job.policy)
    statistics: list[Statistic] = []

    def write(connection: Connection) -> None:
        register_checkpoint(connection, workspace, job.context.number, job.policy, path)
        store_statistics(connection, job.context.number, job.policy, statistics)

    if workspace.config.train.command is not None:
        train_externally(workspace, job, path)
        return Product(f"{workspace.relative(path)}, by your trainer", write)
    if trainable is None:
        raise ConfigError(
            f"detector '{workspace.config.detector.name}' cannot be trained by curate; train it "
            f"yourself on {export.file(workspace, job.context, job.policy)}, or use --command"
        )
    section, number = workspace.config.train, job.context.number
    uses_unlabeled = open_policy(workspace.config, job.policy).uses_unlabeled
    if ignores := section.ignore_proposals and uses_unlabeled:
        propose(workspace, "unlabeled", number, job.policy, progress)
    report = train_with_progress(
        workspace,
        labels=export.file(workspace, job.context, job.policy),
        output=path,
        settings=training_settings(
            workspace,
            section.round_steps,
            section.round_learning_rate,
            job.context.number,
            method_of(workspace.config, job.policy),
        ),
        start=job.context.teacher.path if section.start == "teacher" else None,
        frames=section.batch_size + section.unlabeled_batch_size,
        progress=progress,
        regions=proposed_regions(workspace, number) if ignores else None,
    )
    statistics += report.statistics
    return Product(f"{report.steps} steps, {workspace.relative(path)}", write)


def store_statistics(
    connection: Connection, round_number: int, policy: str, statistics: "Sequence[Statistic]"
) -> None:
    """Store the curves of a training; they replace earlier ones, and NaN becomes null."""
    table = bulk.table("training_statistics")
    connection.execute(
        table.delete().where(table.c.round == round_number, table.c.policy == policy)
    )
    rows = [
        {
            "round": round_number,
            "policy": policy,
            "step": each.step,
            "name": each.name,
            "value": each.value if isfinite(each.value) else None,
        }
        for each in statistics
    ]
    bulk.insert_rows(connection, "training_statistics", rows)


def training_settings(
    workspace: Workspace,
    steps: int,
    learning_rate: float,
    round_number: int,
    method: Method,
) -> "TrainingSettings":
    """Return the trainer's settings.

    Args:
        workspace: the workspace.
        steps: number of optimiser steps.
        learning_rate: peak learning rate.
        round_number: number e of the round; 0 for the first teacher.
        method: the method.

    Raises:
        ConfigError: if `train.options` has a setting that the trainer does not have, or a wrong
            value, or the device does not have the precision.
    """
    from curate.training.settings import TrainingSettings

    section = workspace.config.train
    check_training_options(workspace.config)
    device = choose_device(workspace.config.detector.device)
    if section.precision != FLOAT32:
        with error_prefix("train.precision"):
            mixed_precision(section.precision, device)
    values: dict[str, Any] = {
        "preset": trained_detector(workspace.config).preset,
        "steps": steps,
        "batch_size": section.batch_size,
        "unlabeled_batch_size": section.unlabeled_batch_size,
        "learning_rate": learning_rate,
        "processes": 1,  # decided when the training begins
        "threads": section.threads,
        "pasted": section.pasted,
        "teacher": method.teacher,
        "ema_decay": section.ema_decay,
        "statistics_steps": section.statistics_steps,
        "seed": workspace.config.run.seed + round_number,
        "device": device,
        "loaders": loaders(section, device),
        "precision": section.precision,
    }
    return TrainingSettings(**{**values, **section.options})


def train_with_progress(
    workspace: Workspace,
    *,
    labels: Path,
    output: Path,
    settings: "TrainingSettings",
    start: Path | None,
    frames: int,
    progress: Progress,
    regions: IgnoredRegions | None = None,
) -> "TrainingReport":
    """Train the configured detector, and show the number of steps and the loss as progress.

    Args:
        workspace: the workspace.
        labels: see `curate.training.trainer.train`.
        output: see there.
        settings: see there; the number of processes is decided here.
        start: see there.
        frames: frames per step, at most.
        progress: shows the steps.
        regions: see `curate.training.trainer.train`.
    """
    from curate.training.trainer import train
    from pipelines.engine.training import plan_training

    config = workspace.config
    processes, launch = plan_training(config, settings.steps, frames, settings.device)
    with progress.track(output.stem, settings.steps) as advance:
        reach = as_total(advance)

        def show(step: int, steps: int, loss: float) -> None:
            reach(step, steps, f"loss {loss:.2f}")

        return train(
            trained_detector(config).detector,
            labels,
            output,
            replace(settings, processes=processes),
            start=start,
            options=config.detector.options,
            read=FrameReader(config, workspace.dataset),
            progress=show,
            launch=launch,
            regions=regions,
        )


class FrameReader:
    """Reads the frames of a data set; another process that it is sent to opens the data set anew.

    Args:
        config: the configuration.
        dataset: the open data set; None to open it for the first frame.
    """

    def __init__(self, config: Config, dataset: Dataset | None = None) -> None:
        self._config = config
        self._dataset = dataset

    def __call__(self, frame_id: str) -> Frame:
        """Return the frame."""
        if self._dataset is None:
            self._dataset = open_dataset(self._config)
        return self._dataset.read(frame_id)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what makes the same reader in another process."""
        return type(self), (self._config,)
