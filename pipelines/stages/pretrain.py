"""pretrain: train the first teacher w_0 on X_l alone; not used with an external detector."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, func, select

from curate.category_names import listed
from curate.detectors.devices import AUTO
from curate.errors import ConfigError, WorkspaceError
from db import bulk
from pipelines.assembly import trained_detector
from pipelines.engine.progress import Progress
from pipelines.engine.rounds import register_checkpoint
from pipelines.engine.stage import Product
from pipelines.stages.export import register_label_file, write_label_file
from pipelines.stages.methods import METHODS
from pipelines.stages.train_round import (
    store_statistics,
    train_with_progress,
    training_settings,
    unset_precision,
)
from pipelines.workspace.workspace import Workspace

if TYPE_CHECKING:
    from curate.training.settings import TrainingSettings

_LATER_SETTINGS = {  # settings without effect on the first training
    "round_steps", "round_learning_rate", "unlabeled_batch_size", "processes", "threads",
    "start", "loaders", "zero_weight", "teacher", "ema_decay", "command", "labels_format",
    "statistics_steps", "ignore_proposals",
}  # fmt: skip


def settings(workspace: Workspace) -> Any:
    """Return everything that the first teacher depends on.

    Raises:
        WorkspaceError: if there are no labeled frames.
    """
    config, labeled = workspace.config, workspace.frames("labeled")
    if not labeled:
        raise WorkspaceError(
            "no labeled frames to train from; choose some with `curate init --labeled`"
        )
    trained = trained_detector(config)
    renamed = [config.dataset.rename] if config.dataset.rename else []
    return [
        *renamed,
        config.train.model_dump(
            mode="json", exclude=_LATER_SETTINGS.union(unset_precision(config.train))
        )
        | {"preset": trained.preset},
        sorted(labeled),
        config.run.seed,
        AUTO,  # the device: a teacher is kept, wherever it was trained
        config.dataset.categories,
        config.detector.name,
        trained.detector.checkpoint_version,
    ]


def check(workspace: Workspace) -> None:
    """Check the settings of the trainer.

    Raises:
        ConfigError: if the trainer does not have a setting, or its value is wrong.
    """
    _training_settings(workspace)


def file(workspace: Workspace) -> Path:
    """Return the path of the first teacher's checkpoint."""
    suffix = trained_detector(workspace.config).detector.checkpoint_suffix
    return workspace.root / "checkpoints" / f"round-00{suffix}"


def guard(workspace: Workspace) -> None:
    """Check the leakage firewall, and that there is something to learn.

    Raises:
        LeakageError: if ground truth of unlabeled or val frames would be trained on.
        ConfigError: if there is no object of any category to learn from.
    """
    from pipelines.firewall.rules import enforce

    enforce(workspace, file=_labels(workspace))
    _check_objects(workspace)


def _check_objects(workspace: Workspace) -> None:
    """Raise ConfigError if X_l has no object of any category."""
    truth, categories = bulk.table("ground_truth"), workspace.config.dataset.categories
    query = select(truth.c.category, func.count()).where(truth.c.split == "labeled")
    found: dict[str, int] = dict(sorted(workspace.database.rows(query.group_by(truth.c.category))))
    if not any(name in categories for name in found):
        frames = len(workspace.frames("labeled"))
        raise ConfigError(
            f"no object to learn from: the label files of the {frames} labeled frames have "
            f"{listed(found) or 'no objects'}, and dataset.categories are {listed(categories)}; "
            "label other frames, or map names with dataset.rename"
        )


def run(workspace: Workspace, progress: Progress) -> Product:
    """Train the first teacher."""
    config, path, labels = workspace.config, file(workspace), _labels(workspace)
    write_label_file(workspace, labels, 0, "")
    report = train_with_progress(
        workspace,
        labels=labels,
        output=path,
        settings=_training_settings(workspace),
        start=None,
        frames=config.train.batch_size,
        progress=progress,
    )

    def write(connection: Connection) -> None:
        register_checkpoint(connection, workspace, 0, "", path)
        store_statistics(connection, 0, "", report.statistics)
        register_label_file(connection, workspace, labels, 0, "")

    frames = len(workspace.frames("labeled"))
    return Product(f"{report.steps} steps on {frames} frames, {workspace.relative(path)}", write)


def _training_settings(workspace: Workspace) -> "TrainingSettings":
    section = workspace.config.train
    return training_settings(
        workspace, section.pretrain_steps, section.learning_rate, 0, METHODS["baseline"]
    )


def _labels(workspace: Workspace) -> Path:
    """Return the path of the label file that the first teacher is trained on."""
    return workspace.root / "exports" / "labeled.sqlite"
