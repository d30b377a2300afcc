"""Checkpoints in OpenPCDet's form: {"model_state": tensors by name, ...} in a .pth file.

They are loaded with `weights_only`: nothing in such a file is executed. Checkpoints that curate has
trained have the same form, and in addition the model file, so that they need no other file.
OpenPCDet ignores the additional entries.
"""

import io
import json
import pickle
import struct
import warnings
import zipfile
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.serialization import safe_globals

from curate.detectors.openpcdet.network import DetectionNetwork
from curate.detectors.openpcdet.presets import FORMAT_VERSION
from curate.detectors.openpcdet.schema import ModelFile, load_model_file, parse_model_file
from curate.errors import ConfigError, ModelError, first_line
from curate.files.atomic import replace_file

FORMAT = "curate-openpcdet"
# The first sparse convolution has 4 channels in; its weight shows the layout of the whole file.
_FIRST_SPARSE = "backbone_3d.conv_input.0.weight"
_MOST_NAMES = 4
# What torch raises for damaged files.
_DAMAGED = (
    ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, MemoryError, OSError,
    RuntimeError, TypeError, ValueError, struct.error, zipfile.BadZipFile,
)  # fmt: skip
_UNREADABLE = "not a readable checkpoint: damaged, incomplete, or not written by torch.save"


@dataclass(frozen=True)
class Checkpoint:
    """The content of a checkpoint file.

    Attributes:
        weights: tensors by name.
        file: the model file; None if the checkpoint has none and none was found.
        preset: preset that curate trained it from; None for a checkpoint of OpenPCDet.
    """

    weights: Mapping[str, Tensor]
    file: ModelFile | None
    preset: str | None


def load_checkpoint(path: Path, config: Path | None = None) -> Checkpoint:
    """Return a checkpoint and its model file.

    Args:
        path: the .pth file.
        config: its model file (YAML); by default the one in the checkpoint, or else the file of
            the same name beside it.

    Raises:
        ModelError: if the checkpoint is missing, damaged, or needs code to load.
        ConfigError: if the model file is missing or not usable.
    """
    content = _content(path)
    own = content.get("format") == FORMAT
    if own and content.get("format_version") != FORMAT_VERSION:
        raise ModelError(
            f"{path}: checkpoint format {content.get('format_version')}, this version reads "
            f"{FORMAT_VERSION}; train again"
        )
    beside = path.with_suffix(".yaml")
    file: ModelFile | None
    if config is not None:
        file = load_model_file(config)
    elif own:
        file = _stored_file(path, content)
    else:
        file = load_model_file(beside) if beside.is_file() else None
    preset = content.get("preset") if own else None
    return Checkpoint(_weights(path, content["model_state"]), file, preset)


def load_network(path: Path, config: Path | None = None) -> tuple[DetectionNetwork, Checkpoint]:
    """Return the network of a checkpoint with its weights, in evaluation mode on the CPU.

    Raises:
        ModelError: if the checkpoint cannot be used, or its tensors are not those of the model
            file; the message names those that differ.
        ConfigError: if there is no model file, or it is not usable.
    """
    checkpoint = load_checkpoint(path, config)
    if checkpoint.file is None:
        raise ConfigError(
            f"{path}: a checkpoint of OpenPCDet needs its model file: give --detector-config "
            f"FILE.yaml (detector.options.config), or put {path.stem}.yaml beside it"
        )
    network = DetectionNetwork(checkpoint.file)
    place = str(config or path.with_suffix(".yaml")) if checkpoint.preset is None else "its preset"
    load_weights(network, checkpoint.weights, str(path), place)
    return network.eval(), checkpoint


def save_checkpoint(
    path: Path, network: DetectionNetwork, weights: Mapping[str, Tensor], preset: str
) -> None:
    """Write a checkpoint with its model file, atomically."""
    state = {name: each.detach().cpu().contiguous().clone() for name, each in weights.items()}
    content = {
        "model_state": state,
        "epoch": 0,
        "it": 0,
        "optimizer_state": None,
        "version": FORMAT,
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "preset": preset,
        "config": network.file.to_text(),
    }
    written = io.BytesIO()
    torch.save(content, written)
    replace_file(path, written.getvalue())


def load_weights(
    network: DetectionNetwork, weights: Mapping[str, Tensor], place: str, file: str
) -> None:
    """Load weights into a network; every tensor has to be there with its shape, and no other.

    Raises:
        ModelError: if they are not those of the network.
    """
    expected = network.state_dict()
    given = _spconv_2(weights, expected)
    missing = [name for name in expected if name not in given and not _is_counter(name)]
    surplus = [name for name in given if name not in expected]
    if missing or surplus:
        faults = [
            f"{what} {_listed(_gathered(names, others))}"
            for what, names, others in (
                ("has no", missing, given),
                ("has also", surplus, expected),
            )
            if names
        ]
        raise ModelError(f"{place}: not a checkpoint of {file}: it {' and '.join(faults)}")
    wrong = [
        name
        for name, each in given.items()
        if (each.shape, each.is_floating_point())
        != (expected[name].shape, expected[name].is_floating_point())
    ]
    if wrong:
        shapes = [
            f"{name} {_shape(given[name])} instead of {_shape(expected[name])}" for name in wrong
        ]
        hint = (
            "; the first numbers of dense_head follow from CLASS_NAMES and the anchors"
            if all(name.startswith("dense_head.") for name in wrong)
            else ""
        )
        raise ModelError(f"{place}: not a checkpoint of {file}: {_listed(shapes)}{hint}")
    unfit = [name for name, each in given.items() if not torch.isfinite(each.float()).all()]
    if unfit:
        raise ModelError(f"{place}: NaN or infinite weights in {_listed(unfit)}")
    network.load_state_dict(given, strict=False)


def _spconv_2(
    weights: Mapping[str, Tensor], expected: Mapping[str, Tensor]
) -> Mapping[str, Tensor]:
    """Return the weights with sparse convolutions in the layout of spconv 2.

    spconv 1 stores (z, y, x, in, out) instead of (out, z, y, x, in). Where in and out are equal,
    the shape does not tell: the first layer decides for the whole file.
    """
    first, wanted = weights.get(_FIRST_SPARSE), expected.get(_FIRST_SPARSE)
    if first is None or wanted is None or first.dim() != 5:
        return weights
    if first.shape == wanted.shape or first.permute(4, 0, 1, 2, 3).shape != wanted.shape:
        return weights
    return {
        name: each.permute(4, 0, 1, 2, 3).contiguous()
        if name.startswith("backbone_3d.") and each.dim() == 5
        else each
        for name, each in weights.items()
    }


def _weights(path: Path, state: Mapping[str, Any]) -> Mapping[str, Tensor]:
    """Return the tensors of a state by name, without `module.` and OpenPCDet's step counter."""
    named = {str(name).removeprefix("module."): each for name, each in state.items()}
    weights = {name: each for name, each in named.items() if name != "global_step"}
    others = [name for name, each in weights.items() if not isinstance(each, Tensor)]
    if others:
        raise ModelError(f"{path}: {_listed(others)} in model_state are not tensors")
    return weights


def _content(path: Path) -> Mapping[str, Any]:
    """Return the dictionary in a checkpoint file."""
    if path.suffix in {".yaml", ".yml"}:
        raise ModelError(
            f"{path}: this is a model file, not a checkpoint: give the .pth file as detector.path, "
            "and this one as detector.options.config"
        )
    try:
        _check_checksums(path)
        # The warnings are about old formats.
        with warnings.catch_warnings(action="ignore"), safe_globals(_numbers()):
            content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise ModelError(f"{path}: no such checkpoint") from None
    except pickle.UnpicklingError as error:
        if "Unsupported global" in str(error) or "GLOBAL" in str(error):
            raise ModelError(
                f"{path}: not loaded, because it contains Python code besides weights; save it "
                "again with only tensors, numbers and strings"
            ) from None
        raise ModelError(f"{path}: {_UNREADABLE}") from None
    except (IsADirectoryError, PermissionError) as error:
        raise ModelError(f"{path}: not a readable checkpoint: {error.strerror}") from None
    except _DAMAGED:
        raise ModelError(f"{path}: {_UNREADABLE}") from None
    if not isinstance(content, dict) or not isinstance(content.get("model_state"), dict):
        raise ModelError(f"{path}: not a checkpoint of OpenPCDet: it has no model_state")
    return content


def _numbers() -> list[Any]:
    """Return what is needed to load numbers of numpy.

    OpenPCDet's learning rate schedules put them into the state of the optimiser.
    """

    def scalar_of(core: str) -> Any:
        def scalar(kind: np.dtype, data: bytes) -> Any:
            return np.frombuffer(data, kind)[0]

        scalar.__module__, scalar.__qualname__ = f"numpy.{core}.multiarray", "scalar"
        return scalar

    kinds = [type(np.dtype(each)) for each in ("f4", "f8", "i4", "i8", "?")]
    return [np.dtype, *kinds, scalar_of("core"), scalar_of("_core")]  # of numpy 1 and 2


def _check_checksums(path: Path) -> None:
    """Raise BadZipFile if a part of the file has changed: torch does not compare checksums.

    torch stores the parts as they are. One that is compressed could expand to any size.
    """
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            stored = all(each.compress_type == zipfile.ZIP_STORED for each in archive.infolist())
            if not stored or archive.testzip() is not None:
                raise zipfile.BadZipFile


def _stored_file(path: Path, content: Mapping[str, Any]) -> ModelFile:
    """Return the model file in a checkpoint of curate."""
    try:
        return parse_model_file(json.loads(content["config"]), str(path))
    except (*_DAMAGED, ConfigError) as error:
        raise ModelError(f"{path}: damaged model file: {first_line(error)}; train again") from None


def _is_counter(name: str) -> bool:
    """Return whether a tensor counts batches, which files of old versions lack."""
    return name.endswith("num_batches_tracked")


def _shape(tensor: Tensor) -> str:
    """Return the shape as text, with the type of other numbers than floats."""
    kind = "" if tensor.is_floating_point() else f" {tensor.dtype}".replace("torch.", "")
    return ("x".join(map(str, tensor.shape)) or "a number") + kind


def _gathered(names: list[str], others: Mapping[str, Tensor]) -> list[str]:
    """Return the names, with `module.*` in place of several of a module that the others lack."""
    known = {name.partition(".")[0] for name in others}
    counts = Counter(name.partition(".")[0] for name in names)
    whole = {module for module, count in counts.items() if count > 1} - known
    modules = ((name, name.partition(".")[0]) for name in names)
    return list(dict.fromkeys(f"{each}.*" if each in whole else name for name, each in modules))


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return ", ".join(names[:_MOST_NAMES]) + more
