"""Export the network of a detector as an ONNX model."""

from dataclasses import dataclass
from pathlib import Path

from curate.detectors.base import ExportsOnnx
from curate.errors import ConfigError
from pipelines import registry
from pipelines.engine.rounds import newest_checkpoint
from pipelines.workspace.workspace import Workspace


@dataclass(frozen=True)
class ExportedModel:
    """An exported model.

    Attributes:
        checkpoint: the file that was exported.
        output: the ONNX file.
        usage: its inputs, its outputs and how to use it, in lines.
    """

    checkpoint: Path
    output: Path
    usage: tuple[str, ...]


def export_onnx(
    workspace: Workspace, checkpoint: Path | None, output: Path | None
) -> ExportedModel:
    """Write a checkpoint of the configured detector as an ONNX model.

    Args:
        workspace: see `Workspace`.
        checkpoint: the file; by default the newest one of the workspace.
        output: the ONNX file; by default in its folder exports.

    Raises:
        ConfigError: if the detector has no network, or ONNX has no operators for it.
        ModelError: if the checkpoint cannot be used.
        WorkspaceError: if there is no checkpoint yet.
    """
    section = workspace.config.detector
    detector = registry.DETECTORS.load(section.name)
    if not isinstance(detector, ExportsOnnx):
        raise ConfigError(f"detector '{section.name}' has no network that curate can export")
    source = checkpoint or newest_checkpoint(workspace)
    if source is None:
        raise ConfigError(f"detector '{section.name}' has no checkpoint to export")
    target = output or workspace.root / "exports" / f"{source.stem}.onnx"
    return ExportedModel(source, target, detector.export_onnx(source, target, section.options))
