"""How many processes a training gets, and the warnings for machines that are too small."""

from pathlib import Path
from typing import Any

import pytest

from curate.training.processes import run_in_processes
from curate.warnings_once import warn_once
from pipelines.engine import training
from pipelines.engine.executors import machine
from pipelines.engine.training import plan_training
from pipelines.workspace.config import Config, make_config


def config(**train: object) -> Config:
    """Return a configuration."""
    return make_config({"dataset": {"root": Path()}, "train": train}, "test")


@pytest.fixture(autouse=True)
def _machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have four cores and enough memory, and forget what was said in earlier tests."""
    warn_once.cache_clear()
    monkeypatch.setattr(training, "usable_cores", lambda: 4)
    monkeypatch.setattr(machine, "_free_memory", lambda: 64 << 30)


@pytest.mark.parametrize(
    ("settings", "steps", "frames", "expected"),
    [
        ({}, 1000, 4, 1),  # the result of a seed does not depend on the machine
        ({"processes": 3}, 1, 2, 3),
        ({"processes": "auto"}, 1000, 8, 4),
        ({"processes": "auto"}, 1000, 2, 2),
        ({"processes": "auto", "threads": 2}, 1000, 8, 2),
        ({"processes": "auto", "threads": 8}, 1000, 8, 1),
        ({"processes": "auto"}, 20, 8, 1),  # their start would take longer
    ],
)
def test_the_number_of_processes(
    settings: dict, steps: int, frames: int, expected: int, caplog: Any
) -> None:
    assert plan_training(config(**settings), steps, frames, "cpu") == (expected, run_in_processes)
    assert caplog.text == ""


def test_more_processes_than_cores_give_one_warning(caplog: Any) -> None:
    for _ in range(4):  # trainings of a run
        assert plan_training(config(processes=3, threads=2), 9, 8, "cpu")[0] == 3
    [record] = caplog.records
    assert record.message == (
        "train.processes is 3 and train.threads 2, but only 4 cores can be used: a training with "
        "more processes than cores is slower"
    )


def test_far_too_many_processes_give_one_warning(
    caplog: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cores, the memory and the frames of a step all set a limit."""
    assert plan_training(config(processes=100), 9, 8, "cpu")[0] == 8
    [record] = caplog.records
    assert record.message.startswith("train.processes is 100 and train.threads 1, but only 4 cores")
    caplog.clear()
    monkeypatch.setattr(machine, "_free_memory", lambda: 3 << 30)
    assert plan_training(config(processes=100), 9, 8, "cpu")[0] == 2
    [record] = caplog.records
    assert record.message.startswith("2 of 8 processes: each needs")


def test_the_memory_bounds_the_processes(caplog: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "_free_memory", lambda: 3 << 30)
    assert plan_training(config(processes=4), 9, 8, "cpu")[0] == 2
    [record] = caplog.records
    assert record.message == "2 of 4 processes: each needs about 1024 MiB, and 3072 MiB are free"
