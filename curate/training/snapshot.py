"""Snapshots of a training: a killed training resumes from the last one with the same result."""

import hashlib
import io
import json
import logging
import pickle
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from curate.detectors.base import TrainableDetector
from curate.files.atomic import replace_file
from curate.training.settings import TrainingSettings

_log = logging.getLogger(__name__)

# Settings that do not change the result.
_WITHOUT_EFFECT = ("cache_bytes", "loaders", "snapshot_seconds", "statistics_steps")


def fingerprint(
    detector: type[TrainableDetector],
    labels: Path,
    settings: TrainingSettings,
    start: Path | None,
) -> str:
    """Return the SHA-256, in hexadecimal, of everything that a training's result depends on."""
    relevant = {key: value for key, value in asdict(settings).items() if key not in _WITHOUT_EFFECT}
    trained = [detector.__module__, detector.__qualname__, detector.checkpoint_version]
    digest = hashlib.sha256(json.dumps([trained, relevant, torch.__version__]).encode())
    for path in (labels, start):
        digest.update(path.read_bytes() if path else b"from scratch")
    return digest.hexdigest()


def snapshot_path(output: Path) -> Path:
    """Return the path of the snapshot of the training that writes `output`."""
    return output.with_name(f".{output.name}.training")


def save_snapshot(
    output: Path,
    mark: str,
    networks: Sequence[torch.nn.Module],
    optimizer: torch.optim.Optimizer,
    progress: dict[str, Any],
) -> None:
    """Write the state of a training atomically.

    Args:
        output: the checkpoint that the training will write.
        mark: `fingerprint` of the training.
        networks: the student and, if there is one, its moving average.
        optimizer: optimiser of the student.
        progress: plain numbers and lists.
    """
    buffer = io.BytesIO()
    state = {
        "fingerprint": mark,
        "networks": [network.state_dict() for network in networks],
        "optimizer": optimizer.state_dict(),
        "progress": progress,
    }
    torch.save(state, buffer)
    replace_file(snapshot_path(output), buffer.getvalue())


def load_snapshot(
    output: Path,
    mark: str,
    networks: Sequence[torch.nn.Module],
    optimizer: torch.optim.Optimizer,
) -> dict[str, Any] | None:
    """Load the snapshot of a killed training into the networks and return its progress.

    Returns None if there is no snapshot, it is damaged, or it is from a training with other labels,
    other settings or another start. Only tensors and plain values are read from the file.
    """
    path = snapshot_path(output)
    if not path.exists():
        return None
    try:
        content = io.BytesIO(path.read_bytes())
        state = torch.load(content, map_location="cpu", weights_only=True)
        matches = state["fingerprint"] == mark
    except (RuntimeError, pickle.UnpicklingError, EOFError, KeyError, TypeError, ValueError):
        _log.warning("%s is damaged; training starts from the beginning", path)
        return None
    if not matches:
        _log.info("%s is from another training; training starts from the beginning", path)
        return None
    for network, weights in zip(networks, state["networks"], strict=True):
        network.load_state_dict(weights)
    optimizer.load_state_dict(state["optimizer"])
    return dict(state["progress"])
