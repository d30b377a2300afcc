"""pretrain: the first teacher w_0, from X_l alone; a detector that the user brings needs none."""

from sqlalchemy import Connection

from curate.detectors.pillars.checkpoint import FORMAT_VERSION
from curate.errors import ConfigError, WorkspaceError
from pipelines.engine import plan
from pipelines.engine.progress import Progress
from pipelines.engine.rounds import is_trainable, register_checkpoint
from pipelines.engine.runner import Report, run_once
from pipelines.engine.stage import Product
from pipelines.firewall.rules import enforce
from pipelines.stages.export import register_label_file, write_label_file
from pipelines.stages.methods import METHODS
from pipelines.stages.train_round import train_with_progress, training_settings
from pipelines.workspace.workspace import Workspace


def pretrain(workspace: Workspace, progress: Progress) -> Report:
    """Trains w_0, unless it exists with the current settings.

    Raises:
        ConfigError: curate cannot train the configured detector.
        WorkspaceError: there are no labeled frames.
        LeakageError: ground truth would reach what it must not, see `firewall`.
    """
    config = workspace.config
    if not is_trainable(workspace):
        raise ConfigError(
            f"detector '{config.detector.name}' needs no pretraining; run `curate predict`"
        )
    labeled = workspace.frames("labeled")
    if not labeled:
        raise WorkspaceError("no labeled frames to learn from; `curate init --labeled` takes some")
    settings = config.train.model_dump(
        mode="json",
        exclude={
            "round_steps",
            "round_learning_rate",
            "unlabeled_batch_size",
            "threads",
            "start",
            "zero_weight",
            "teacher",
            "ema_decay",
            "command",
            "labels_format",
        },
    )
    key = [
        settings,
        sorted(labeled),
        config.run.seed,
        config.detector.device,
        config.dataset.categories,
        FORMAT_VERSION,
    ]
    path = workspace.root / "checkpoints" / "round-00.safetensors"
    labels = workspace.root / "exports" / "labeled.sqlite"

    def make() -> Product:
        write_label_file(workspace, labels, 0, "")
        report = train_with_progress(
            labels=labels,
            output=path,
            settings=training_settings(
                workspace,
                config.train.pretrain_steps,
                config.train.learning_rate,
                0,
                METHODS["baseline"],
            ),
            start=None,
            read=workspace.dataset.read,
            progress=progress,
        )
        summary = f"{report.steps} steps on {len(labeled)} frames, {workspace.relative(path)}"
        return Product(summary, write)

    def write(connection: Connection) -> None:
        register_checkpoint(connection, workspace, 0, "", path)
        register_label_file(connection, workspace, labels, 0, "")

    with workspace.database.claiming_round(0, None, "pretrain"):
        enforce(workspace, file=labels)
        return run_once(workspace, plan.Once(0, "pretrain", ""), plan.digest(key), path, make)
