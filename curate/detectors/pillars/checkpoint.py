"""Checkpoints of the pillar detector: safetensors with what is needed to rebuild the network.

Nothing in such a file is ever executed, and neither torch nor a GPU is needed to read it. The ONNX
graph beside a checkpoint is derived from it, and made again where it is missing or of another one.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from curate.detectors.pillars.presets import PRESETS, Preset
from curate.errors import ModelError, first_line
from curate.files.atomic import replace_file

FORMAT = "curate-pillars"
# Version 2 added the estimate of the IoU, version 3 measures heights from the ground.
FORMAT_VERSION = "3"
_LENGTH_BYTES = 8  # of the number before a safetensors header, and the header's alignment

# Key in the graph's metadata of the digest of the checkpoint that it was made from. The number
# grows with every change of what a graph answers, so that older ones are made again.
GRAPH_DIGEST = "checkpoint_sha256_3"


@dataclass(frozen=True)
class Checkpoint:
    """A trained pillar detector.

    Attributes:
        preset: grid and size of the network.
        categories: what it finds, in the order of its heatmaps.
        weights: the network's state by name.
    """

    preset: Preset
    categories: tuple[str, ...]
    weights: Mapping[str, np.ndarray]


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write the checkpoint and, beside it, its ONNX graph; each file whole or not at all."""
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
    """Return the same safetensors file with its header sorted.

    The library writes the metadata in an order that it draws anew in every process. Equal weights
    must have equal bytes: what a teacher has said is kept as long as its hash is the same.
    """
    start = _LENGTH_BYTES + int.from_bytes(content[:_LENGTH_BYTES], "little")
    entries = json.loads(content[_LENGTH_BYTES:start])
    header = json.dumps(entries, sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % _LENGTH_BYTES)  # tensors stay aligned
    return len(header).to_bytes(_LENGTH_BYTES, "little") + header + content[start:]


def load_checkpoint(path: Path) -> Checkpoint:
    """Return the checkpoint in a file.

    Raises:
        ModelError: if the file is missing, damaged, or no checkpoint of this detector, or a weight
            of it is no number.
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
    broken = [name for name, values in weights.items() if not np.isfinite(values).all()]
    if broken:  # it would find nothing in any frame, and no one would be told
        raise ModelError(f"{path}: {broken[0]} holds NaN or infinite weights; train again")
    return Checkpoint(preset, categories, weights)


def digest_of(path: Path) -> str:
    """SHA-256 of the checkpoint file, in hexadecimal.

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
    """Where the ONNX graph of the checkpoint at `path` lies."""
    return path.with_suffix(".onnx")


def write_graph(path: Path, checkpoint: Checkpoint, digest: str) -> None:
    """Write the ONNX graph beside the checkpoint at `path`, marked with the checkpoint's digest.

    Raises:
        ModelError: if the checkpoint lacks tensors, or the graph cannot be written.
    """
    # Predicting needs onnx only where the graph is missing.
    from curate.detectors.pillars.onnx_graph import build_graph

    try:
        model = build_graph(checkpoint.weights, checkpoint.preset, len(checkpoint.categories))
    except (KeyError, ValueError) as error:
        raise ModelError(f"{path}: damaged checkpoint: {first_line(error)}; train again") from None
    model.metadata_props.add(key=GRAPH_DIGEST, value=digest)
    try:
        replace_file(graph_path(path), model.SerializeToString())
    except OSError as error:
        raise ModelError(f"{graph_path(path)}: cannot be written: {error.strerror}") from None
