"""Checkpoints of the pillar detector: safetensors files with all data to rebuild the network.

Nothing in such a file is ever executed, and reading it needs neither torch nor a GPU. The ONNX
graph beside a checkpoint is derived from it. It is built again if it is missing or belongs to
another checkpoint.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from curate.detectors.pillars.presets import PRESETS, Preset
from curate.errors import ModelError, first_line
from curate.files.atomic import replace_file

if TYPE_CHECKING:
    from onnx import ModelProto

FORMAT = "curate-pillars"
# Version 2 added the IoU estimate, version 3 measures heights from the ground.
FORMAT_VERSION = "3"
_LENGTH_BYTES = 8  # size of the number before a safetensors header; also the header's alignment

# Metadata key of the graph with the digest of its checkpoint. Increase the number in the key when
# the outputs of the graph change: older graphs are then built again.
GRAPH_DIGEST = "checkpoint_sha256_3"


@dataclass(frozen=True)
class Checkpoint:
    """A trained pillar detector.

    Attributes:
        preset: grid and size of the network.
        categories: categories that it detects, in the order of its heatmaps.
        weights: state of the network, tensors by name.
    """

    preset: Preset
    categories: tuple[str, ...]
    weights: Mapping[str, np.ndarray]


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write the checkpoint and, beside it, its ONNX graph, each file atomically."""
    metadata = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "preset": checkpoint.preset.name,
        "categories": json.dumps(list(checkpoint.categories)),
    }
    tensors = {name: np.ascontiguousarray(array) for name, array in checkpoint.weights.items()}
    content = _canonical(save(tensors, metadata))
    write_graph(path, checkpoint, hashlib.sha256(content).hexdigest())
    replace_file(path, content)


def _canonical(content: bytes) -> bytes:
    """Return the same safetensors file with a sorted header.

    The library writes the metadata in an order that differs between processes. Equal weights must
    have equal bytes, because stored predictions stay valid as long as the teacher's hash does.
    """
    start = _LENGTH_BYTES + int.from_bytes(content[:_LENGTH_BYTES], "little")
    entries = json.loads(content[_LENGTH_BYTES:start])
    header = json.dumps(entries, sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % _LENGTH_BYTES)  # tensors stay aligned
    return len(header).to_bytes(_LENGTH_BYTES, "little") + header + content[start:]


def load_checkpoint(path: Path) -> Checkpoint:
    """Return the checkpoint in a file.

    Raises:
        ModelError: if the file is missing, damaged, or not a checkpoint of this detector, or a
            weight is not finite.
    """
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise ModelError(f"{path}: no such checkpoint; train one first") from None
    except (SafetensorError, OSError) as error:
        raise ModelError(f"{path}: not a readable safetensors file: {first_line(error)}") from None
    kind, version = metadata.get("format"), metadata.get("format_version")
    if kind != FORMAT:
        raise ModelError(f"{path}: not a checkpoint of the pillars detector (format {kind!r})")
    if version != FORMAT_VERSION:
        raise ModelError(
            f"{path}: checkpoint format {version}, this version reads {FORMAT_VERSION}; train again"
        )
    try:
        preset = PRESETS[metadata["preset"]]
        categories = tuple(str(name) for name in json.loads(metadata["categories"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError(f"{path}: damaged metadata: {first_line(error)}; train again") from None
    not_finite = [name for name, values in weights.items() if not np.isfinite(values).all()]
    if not_finite:  # such a network finds nothing in any frame, without any error
        raise ModelError(f"{path}: {not_finite[0]} has NaN or infinite weights; train again")
    return Checkpoint(preset, categories, weights)


def digest_of(path: Path) -> str:
    """Return the SHA-256 of the checkpoint file, in hexadecimal.

    Raises:
        ModelError: if the file cannot be read.
    """
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except FileNotFoundError:
        raise ModelError(f"{path}: no such checkpoint; train one first") from None
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror}") from None


def graph_path(path: Path) -> Path:
    """Return the path of the ONNX graph that belongs to the checkpoint at `path`."""
    return path.with_suffix(".onnx")


def write_graph(path: Path, checkpoint: Checkpoint, digest: str) -> None:
    """Write the ONNX graph beside the checkpoint at `path`, with the digest in its metadata.

    Raises:
        ModelError: if the checkpoint lacks tensors, or the graph cannot be written.
    """
    # Deferred import: prediction needs onnx only if the graph is missing.
    from curate.files.onnx_graph import write_model

    model = graph_of(path, checkpoint)
    model.metadata_props.add(key=GRAPH_DIGEST, value=digest)
    write_model(model, graph_path(path))


def graph_of(path: Path, checkpoint: Checkpoint) -> "ModelProto":
    """Return the ONNX graph of the checkpoint at `path`.

    Raises:
        ModelError: if the checkpoint lacks tensors.
    """
    from curate.detectors.pillars.onnx_graph import build_graph

    try:
        return build_graph(checkpoint.weights, checkpoint.preset, len(checkpoint.categories))
    except (KeyError, ValueError) as error:
        raise ModelError(f"{path}: damaged checkpoint: {first_line(error)}; train again") from None
