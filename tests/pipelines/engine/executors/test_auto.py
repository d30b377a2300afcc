"""The default executor: when it starts workers, and how many."""

import logging
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.frame_functions import Napping
from support.rounds import run_workspace
from support.stored_rows import dump
from support.toys import toy_document, write_toy_kitti

from pipelines.engine.executors import auto, machine
from pipelines.engine.executors.auto import AutoExecutor
from pipelines.engine.executors.base import FrameJob
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise


class Hinted:
    """Jobs with a length hint."""

    def __init__(self, count: int, hint: int) -> None:
        self.jobs = iter([FrameJob(key, str(key)) for key in range(count)])
        self.hint = hint

    def __iter__(self) -> Iterator[FrameJob]:
        return self

    def __next__(self) -> FrameJob:
        return next(self.jobs)

    def __length_hint__(self) -> int:
        return self.hint


@pytest.fixture
def executor() -> Iterator[AutoExecutor]:
    made = AutoExecutor(2)
    yield made
    made.close()


def processes(executor: AutoExecutor, seconds: float, jobs: Hinted) -> set[int]:
    """Return the processes that worked on the jobs."""
    outcomes = list(executor.map(Napping(seconds), jobs))
    assert sorted(outcome.job.frame_id for outcome in outcomes) == list(range(len(outcomes)))
    return {outcome.rows[0]["processes"]["pid"][0] for outcome in outcomes}


def test_small_work_stays_in_this_process(executor: AutoExecutor) -> None:
    """17 frames take less time than the start of a worker."""
    assert processes(executor, 0.01, Hinted(17, 14)) == {os.getpid()}


def test_large_work_goes_to_workers_and_they_are_kept(executor: AutoExecutor) -> None:
    """The first frames are measured here; a later stage finds the workers and starts none."""
    first = processes(executor, 0.02, Hinted(20, 100_000))
    assert os.getpid() in first
    assert 2 <= len(first) <= 3
    later = processes(executor, 0.02, Hinted(40, 37))
    assert later - {os.getpid()}
    assert later <= first


def test_one_worker_is_this_process() -> None:
    assert processes(AutoExecutor(1), 0.001, Hinted(10, 1_000_000)) == {os.getpid()}


def test_workers_do_not_change_the_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The switch between two processes in the middle of a stage leaves no trace."""
    write_toy_kitti(tmp_path / "kitti", frames=24, val=2)
    (tmp_path / "detector.txt").write_text("000007")  # the detector raises on this frame
    rows = {}
    for start_s in (1e9, -1e9):  # never workers, always workers
        monkeypatch.setattr(auto, "START_S", start_s)
        document = toy_document(tmp_path / "kitti", tmp_path / "detector.txt")
        document["run"] = {"executor": "auto", "workers": 2}
        workspace = initialise(tmp_path / f"{start_s}", make_config(document, "test"), "0.1", "")
        run_workspace(workspace)
        rows[start_s] = dump(workspace)
    assert rows[1e9] == rows[-1e9]


def test_memory_bounds_the_number_of_workers(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Each needs as much as this process: 4 GiB free, of which 80 % are used, hold 3 of 1 GiB."""
    (tmp_path / "meminfo").write_text("MemTotal: 8388608 kB\nMemAvailable: 4194304 kB\n")
    (tmp_path / "status").write_text("Name: curate\nVmRSS: 1048576 kB\n")
    monkeypatch.setattr(machine, "_MEMINFO", tmp_path / "meminfo")
    monkeypatch.setattr(machine, "_STATUS", tmp_path / "status")
    monkeypatch.setattr(machine, "_CGROUP", tmp_path)
    assert machine.affordable_workers(3) == 3
    with caplog.at_level(logging.WARNING):
        assert machine.affordable_workers(8) == 3
    assert "3 of 8 processes: each needs about 1024 MiB, and 4096 MiB are free" in caplog.text
    (tmp_path / "memory.max").write_text(str(3 << 30))
    (tmp_path / "memory.current").write_text(str(2 << 30))
    (tmp_path / "memory.stat").write_text(f"anon {1 << 30}\nfile {1 << 30}\n")
    assert machine.affordable_workers(8) == 1
    (tmp_path / "status").write_text("")
    assert machine.affordable_workers(8) == 8


def test_a_container_has_fewer_cores(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(machine, "_CGROUP", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)), raising=False)
    assert machine.usable_cores() == 16
    (tmp_path / "cpu.max").write_text("250000 100000\n")
    assert machine.usable_cores() == 2
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert machine.usable_cores() == 16
