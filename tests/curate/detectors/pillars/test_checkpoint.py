"""Checkpoints: writing, reading, and rejecting all other files."""

import pickle

import numpy as np
import pytest
from safetensors.numpy import save_file

from curate.detectors.pillars import PillarDetector
from curate.detectors.pillars import checkpoint as module
from curate.detectors.pillars.checkpoint import load_checkpoint, save_checkpoint
from curate.detectors.pillars.network import PillarNetwork, checkpoint_of, network_of
from curate.detectors.pillars.presets import PRESETS
from curate.errors import ModelError

META = {"format": "curate-pillars", "format_version": "3", "preset": "small"}


@pytest.fixture(scope="module")
def checkpoint():
    """Return the checkpoint of an untrained network of two categories."""
    return checkpoint_of(PillarNetwork(PRESETS["small"], 2), ("Car", "Tram"))


def test_a_checkpoint_is_read_back_unchanged(tmp_path, checkpoint):
    """Preset, categories and every tensor are the same, and the graph is beside the file."""
    path = tmp_path / "new" / "teacher.safetensors"
    save_checkpoint(path, checkpoint)
    loaded = load_checkpoint(path)
    assert loaded.preset == PRESETS["small"]
    assert loaded.categories == ("Car", "Tram")
    assert loaded.weights.keys() == checkpoint.weights.keys()
    for name, array in checkpoint.weights.items():
        np.testing.assert_array_equal(loaded.weights[name], array)
    assert sorted(file.name for file in path.parent.iterdir()) == [
        "teacher.onnx",
        "teacher.safetensors",
    ]


def test_equal_weights_have_equal_bytes(tmp_path, checkpoint, monkeypatch):
    """Repeating a training with the same seed makes nothing stale."""
    monkeypatch.setattr(module, "write_graph", lambda *_: None)
    path = tmp_path / "teacher.safetensors"
    contents = set()
    for _ in range(8):
        save_checkpoint(path, checkpoint)
        contents.add(path.read_bytes())
    assert len(contents) == 1


class Bomb:
    """Executes code when it is unpickled."""

    def __reduce__(self):
        return (pytest.fail, ("a pickle was executed",))


def test_a_pickle_is_rejected_and_never_executed(tmp_path):
    """A pickle with the name of a checkpoint gives a one-line error."""
    path = tmp_path / "foreign.safetensors"
    path.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(
        ModelError, match=r"foreign\.safetensors: not a readable safetensors"
    ) as info:
        PillarDetector(path)
    assert "\n" not in str(info.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"", "not a readable safetensors"), (b"\x00" * 100, "not a readable safetensors")],
)
def test_a_random_file_is_rejected(tmp_path, content, message):
    path = tmp_path / "bad.safetensors"
    path.write_bytes(content)
    with pytest.raises(ModelError, match=message):
        load_checkpoint(path)


def test_a_truncated_checkpoint_is_rejected(tmp_path, checkpoint):
    path = tmp_path / "half.safetensors"
    save_checkpoint(path, checkpoint)
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(ModelError, match=r"half\.safetensors"):
        load_checkpoint(path)


def test_a_missing_checkpoint_is_reported(tmp_path):
    """The error contains the path and what to do."""
    with pytest.raises(ModelError, match=r"nowhere\.safetensors: no such checkpoint; train"):
        PillarDetector(tmp_path / "nowhere.safetensors")


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({}, "not a checkpoint of the pillars detector"),
        ({**META, "format_version": "9", "categories": "[]"}, "checkpoint format 9"),
        (
            {**META, "format_version": "1", "categories": '["Car"]'},
            "checkpoint format 1, this version reads 3; train again",
        ),
        ({**META, "preset": "huge", "categories": '["Car"]'}, "damaged metadata"),
        ({**META, "categories": "Car"}, "damaged metadata"),
        (META, "damaged metadata"),
        ({**META, "categories": '["Car"]'}, "damaged checkpoint"),
    ],
)
def test_unexpected_tensors_are_rejected(tmp_path, metadata, message):
    """Safetensors of another model or another version have different one-line errors."""
    path = tmp_path / "foreign.safetensors"
    save_file({"weight": np.zeros(3, dtype=np.float32)}, path, metadata)
    with pytest.raises(ModelError, match=f"foreign.safetensors: {message}") as info:
        PillarDetector(path)
    assert "\n" not in str(info.value)


def test_tensors_of_another_size_are_rejected(checkpoint):
    """A network is not built from tensors that do not fit it."""
    weights = {**checkpoint.weights, "answer.bias": np.zeros(99, dtype=np.float32)}
    with pytest.raises(ModelError, match=r"answer\.bias"):
        network_of(type(checkpoint)(checkpoint.preset, checkpoint.categories, weights))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_weights_that_are_not_finite_are_rejected(tmp_path, checkpoint, value):
    """They would detect nothing, which looks like empty frames."""
    path = tmp_path / "teacher.safetensors"
    weights = {name: array.copy() for name, array in checkpoint.weights.items()}
    broken = next(name for name, array in weights.items() if array.dtype.kind == "f")
    weights[broken].flat[0] = value
    save_file(weights, path, META | {"categories": '["Car", "Tram"]'})
    with pytest.raises(ModelError, match=f"{broken} has NaN or infinite weights; train again"):
        load_checkpoint(path)
