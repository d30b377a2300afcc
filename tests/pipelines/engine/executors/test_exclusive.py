"""Models on a device that workers should not share: one worker, which reads ahead."""

import os

import pytest
from support.frame_functions import OnDevice

from pipelines.engine.executors.auto import AutoExecutor
from pipelines.engine.executors.base import FrameJob
from pipelines.engine.executors.process import ProcessExecutor
from pipelines.engine.executors.serial import SerialExecutor

JOBS = [FrameJob(key, f"{key:06}") for key in range(4)]


def rows(executor, function):
    """Return process and announced frames of each job, in order."""
    found = sorted(executor.map(function, JOBS), key=lambda each: each.job.frame_id)
    executor.close()
    return [
        (each.rows[0]["done"]["process"][0], each.rows[0]["done"]["announced"][0]) for each in found
    ]


def test_the_next_frame_is_read_while_the_device_computes():
    """It is announced before the current one is computed, and none before it is needed."""
    announced = [each for _, each in rows(SerialExecutor(), OnDevice())]
    assert announced == [[1], [1, 2], [1, 2, 3], [1, 2, 3]]
    assert [each for _, each in rows(SerialExecutor(), OnDevice(exclusive=False))] == [[]] * 4


def test_auto_starts_no_worker_for_a_gpu(monkeypatch):
    """Even if it would save time on the CPU."""
    monkeypatch.setattr(AutoExecutor, "_saves_time", lambda *_: True)
    assert {process for process, _ in rows(AutoExecutor(2), OnDevice())} == {os.getpid()}
    monkeypatch.setattr("pipelines.engine.executors.auto.MEASURED_JOBS", 1)
    assert {process for process, _ in rows(AutoExecutor(2), OnDevice(workers=2))} != {os.getpid()}


@pytest.mark.parametrize("workers", [1, 2])
def test_worker_processes_share_a_gpu_only_on_request(workers):
    """Even where an earlier stage has started more of them."""
    executor = ProcessExecutor(2)
    list(executor.map(OnDevice(exclusive=False, workers=None), JOBS))
    found = rows(executor, OnDevice(workers=workers))
    assert len({process for process, _ in found}) == workers
