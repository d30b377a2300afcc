"""Snapshots of a training: a killed training resumes from the last one with the same result."""

import hashlib
import io
import json
import logging
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from curate.detectors.base import IgnoredRegions, TrainableDetector
from curate.training.settings import TrainingSettings

_log = logging.getLogger(__name__)

# Settings that do not change the result, or only by the rounding of sums (`processes`): a training
# that ran out of memory may resume with fewer processes.
_WITHOUT_EFFECT = ("cache_bytes", "loaders", "processes", "snapshot_seconds", "statistics_steps")


def fingerprint(
    detector: type[TrainableDetector],
    labels: Path,
    settings: TrainingSettings,
    start: Path | None,
    options: Mapping[str, Any],
    regions: IgnoredRegions | None = None,
) -> str:
    """Return the SHA-256, in hexadecimal, of everything that a training's result depends on.

    Args:
        detector: class of the detector.
        labels: the label file.
        settings: the settings.
        start: checkpoint to start from.
        options: the options that the start checkpoint is loaded with; the content of files counts.
        regions: regions to ignore.
    """
    relevant = {key: value for key, value in asdict(settings).items() if key not in _WITHOUT_EFFECT}
    trained = [detector.__module__, detector.__qualname__, detector.checkpoint_version]
    digest = hashlib.sha256(json.dumps([trained, relevant, torch.__version__]).encode())
    for path in (labels, start):
        digest.update(path.read_bytes() if path else b"from scratch")
    for name, value in sorted(options.items()):
        digest.update(f"{name}={value}".encode())
        if isinstance(value, str | Path) and Path(value).is_file():
            digest.update(Path(value).read_bytes())
    for frame, (boxes, categories) in sorted((regions or {}).items()):
        digest.update(f"{frame}={boxes.tolist()}{categories.tolist()}".encode())
    return digest.hexdigest()


def snapshot_path(output: Path) -> Path:
    """Return the path of the snapshot of the training that writes `output`."""
    return output.with_name(f".{output.name}.training")


def pack_snapshot(
    mark: str,
    networks: Sequence[torch.nn.Module],
    optimizer: torch.optim.Optimizer,
    progress: dict[str, Any],
) -> bytes:
    """Return the content of a snapshot file.

    Args:
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
    return buffer.getvalue()


def find_snapshot(output: Path, mark: str) -> bytes | None:
    """Return the content of the snapshot of a killed training.

    Returns None if there is no snapshot, it is damaged, or it is from a training with other labels,
    other settings or another start.
    """
    path = snapshot_path(output)
    if not path.exists():
        return None
    content = path.read_bytes()
    try:
        matches = _state_in(content)["fingerprint"] == mark
    except (RuntimeError, pickle.UnpicklingError, EOFError, KeyError, TypeError, ValueError):
        _log.warning("%s is damaged; training starts from the beginning", path)
        return None
    if not matches:
        _log.info("%s is from another training; training starts from the beginning", path)
        return None
    return content


def restore_snapshot(
    content: bytes, networks: Sequence[torch.nn.Module], optimizer: torch.optim.Optimizer
) -> dict[str, Any]:
    """Load a snapshot into the networks and the optimiser, and return its progress."""
    state = _state_in(content)
    for network, weights in zip(networks, state["networks"], strict=True):
        network.load_state_dict(weights)
    optimizer.load_state_dict(state["optimizer"])
    return dict(state["progress"])


def _state_in(content: bytes) -> Any:
    """Return the state in a snapshot; only tensors and plain values are read from it."""
    return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
