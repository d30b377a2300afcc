"""Batches that other processes prepare, mixed precision, and moves to a device that is not here."""

import multiprocessing
import os
import signal
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from support.killed import Killed, kill_at

from curate.datasets.kitti.dataset import KittiDataset
from curate.detectors.pillars import PillarDetector
from curate.detectors.pillars.checkpoint import load_checkpoint
from curate.errors import ConfigError, CurateError, DataError
from curate.training.batches import Batches
from curate.training.labels import WeightedLabels
from curate.training.loading import to_device
from curate.training.settings import TrainingSettings
from curate.training.trainer import train


def quick(tiny, **changes):
    """Return settings of a training of about a second."""
    settings = {"preset": tiny, "steps": 4, "batch_size": 2, "pasted": 1, "snapshot_seconds": 0.0}
    return TrainingSettings(**(settings | changes))


def weights_of(path):
    """Return all weights of a checkpoint in one row."""
    return np.concatenate([each.ravel() for each in load_checkpoint(path).weights.values()])


class Broken:
    """Reads the frames of a data set; one of them is damaged."""

    def __init__(self, root, frame_id):
        self.dataset = KittiDataset(root)
        self.frame_id = frame_id

    def __call__(self, frame_id):
        """Return the frame."""
        if frame_id == self.frame_id:
            raise DataError(f"frame {frame_id} is damaged")
        return self.dataset.read(frame_id)


def test_loaders_change_no_weight_and_a_killed_one_loses_nothing(make_labels, tiny, tmp_path):
    """To the last bit. The loader is killed at a step; the rerun continues from its snapshot."""

    def kill(step, steps, loss):
        if step == 3:
            for child in multiprocessing.active_children():
                os.kill(child.pid, signal.SIGKILL)

    labels, path = make_labels(labeled=3, unlabeled=3), tmp_path / "a.safetensors"
    settings = quick(tiny, loaders=1, steps=12)
    drawn = torch.random.get_rng_state()
    with pytest.raises(CurateError, match=r"prepares batches was killed.*fewer train\.loaders"):
        train(PillarDetector, labels, path, settings, progress=kill)
    assert train(PillarDetector, labels, path, settings).resumed_at >= 3
    assert torch.equal(torch.random.get_rng_state(), drawn)
    train(PillarDetector, labels, tmp_path / "b.safetensors", replace(settings, loaders=0))
    np.testing.assert_array_equal(weights_of(path), weights_of(tmp_path / "b.safetensors"))


def test_a_frame_that_a_loader_cannot_read_is_one_line(make_labels, tiny, toy_kitti, tmp_path):
    """As without loaders; torch would add a traceback."""
    settings = quick(tiny, loaders=1, unlabeled_batch_size=1)
    broken = Broken(toy_kitti, "000002")
    labels = make_labels(labeled=2, unlabeled=1)
    with pytest.raises(DataError, match=r"^frame 000002 is damaged$"):
        train(PillarDetector, labels, tmp_path / "a.safetensors", settings, read=broken)


class Pair(NamedTuple):
    """A batch as a named tuple."""

    points: torch.Tensor
    count: int


@dataclass(frozen=True)
class Nested:
    """A batch with tensors at several depths."""

    pair: Pair
    by_name: dict
    several: list


def test_all_tensors_of_a_batch_are_moved():
    """On "meta", a device that every machine has."""
    one = torch.ones(2)
    batch = Nested(Pair(one, 2), {"a": (one, "text")}, [one, None])
    moved = to_device(batch, "meta")
    found = [moved.pair.points, moved.by_name["a"][0], moved.several[0]]
    assert {each.device.type for each in found} == {"meta"}
    assert (moved.pair.count, moved.by_name["a"][1], moved.several[1]) == (2, "text", None)
    assert to_device(batch, "cpu") is batch


def test_copies_to_cuda_are_pinned_and_asynchronous(monkeypatch):
    """What is asked of torch; there is no such device here."""
    asked = []
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda self: asked.append("pinned") or self)
    monkeypatch.setattr(
        torch.Tensor, "to", lambda self, device, **options: asked.append((device, options)) or self
    )
    to_device({"a": torch.ones(1)}, "cuda:1")
    assert asked == ["pinned", ("cuda:1", {"non_blocking": True})]


def test_every_operation_of_a_step_stays_on_the_device(make_labels, tiny, monkeypatch):
    """The loss needs values of the device, except for the IoU, which is computed on the CPU."""
    # The number of cells with points is a value as well; without one, all have points.
    monkeypatch.setattr("torch.fx.experimental._config.meta_nonzero_assume_all_nonzero", True)
    labels, settings = WeightedLabels(make_labels(labeled=2)), quick(tiny)
    student = PillarDetector.new_student(tiny, labels.categories)
    batch = student.encode(Batches(labels, settings)[0], "cpu")
    moved = to_device(batch, "meta")
    output = student.network.to("meta")(moved.features, moved.slots, moved.frames)
    assert {each.device.type for each in output} == {"meta"}
    # Apple's GPUs have no float64.
    tensors = [batch.features, batch.slots, *vars(batch.targets).values()]
    assert torch.float64 not in {each.dtype for each in tensors}


@pytest.mark.parametrize("precision", ["bfloat16", "float16"])
def test_mixed_precision_trains_the_same_way_roughly(make_labels, tiny, tmp_path, precision):
    """Weights stay float32 and close to those of full precision; a killed training resumes."""
    labels = make_labels(labeled=2)
    losses = {}
    for name in ("float32", precision):
        settings = quick(tiny, precision=name, statistics_steps=1)
        report = train(PillarDetector, labels, tmp_path / f"{name}.safetensors", settings)
        losses[name] = [each.value for each in report.statistics if each.name == "loss"]
    assert losses[precision] != losses["float32"]
    # The scale of float16 starts too high, and such steps are left out.
    np.testing.assert_allclose(losses[precision][0], losses["float32"][0], rtol=0.01)
    weights = load_checkpoint(tmp_path / f"{precision}.safetensors").weights
    assert {str(each.dtype) for each in weights.values()} == {"float32", "int64"}
    settings = quick(tiny, precision=precision)
    with pytest.raises(Killed):
        train(PillarDetector, labels, tmp_path / "k.safetensors", settings, progress=kill_at(2))
    train(PillarDetector, labels, tmp_path / "k.safetensors", settings)
    np.testing.assert_array_equal(
        weights_of(tmp_path / "k.safetensors"), weights_of(tmp_path / f"{precision}.safetensors")
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"precision": "half"}, "unknown precision 'half'"), ({"loaders": -1}, "loaders is -1")],
)
def test_invalid_settings_are_rejected(settings, message):
    with pytest.raises(ConfigError, match=message):
        TrainingSettings(**settings)
