"""Running a grid with stand-ins for its jobs: order, resuming, failures, locking."""

import signal
import threading
from pathlib import Path

import pytest
from support.bench_results import ToyJobs, make_bench, synthetic_result
from support.silent import Silent

from curate.errors import CellsFailed, WorkspaceError
from pipelines.bench.grid import Job
from pipelines.bench.processes import JobProcesses
from pipelines.bench.results import write_result
from pipelines.bench.running import alone, run_grid
from pipelines.bench.settings import Bench

GRID = {"ratios": (0.25, 0.5), "seeds": (0, 1)}


def run(bench: Bench, jobs: ToyJobs, workers: int = 1) -> list[str]:
    """Run a grid; return its messages."""
    messages: list[str] = []
    run_grid(bench, jobs, workers, messages.append, Silent())
    return messages


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_job_runs_once_and_after_its_dependencies(
    toy_kitti: Path, tmp_path: Path, workers: int
) -> None:
    """With any number of parallel jobs."""
    bench = make_bench(tmp_path, toy_kitti, **GRID)
    jobs = ToyJobs(tmp_path)
    run(bench, jobs, workers)
    assert len(jobs.done) == len(set(jobs.done)) == 12
    for job in jobs.done:
        assert jobs.done.index(job.shared) <= jobs.done.index(job)


def test_finished_cells_are_never_redone(toy_kitti: Path, tmp_path: Path) -> None:
    """A second run finds nothing to do; a larger grid runs only the new cells."""
    run(make_bench(tmp_path, toy_kitti), ToyJobs(tmp_path))
    jobs = ToyJobs(tmp_path)
    assert run(make_bench(tmp_path, toy_kitti), jobs) == ["2 cells, 2 of them already finished"]
    assert jobs.done == []
    run(make_bench(tmp_path, toy_kitti, methods=("baseline", "pspsl", "spsl")), jobs)
    assert jobs.done == [Job(0.25, 0, "spsl")]


def test_the_cost_of_a_job_is_reported_before_it_starts(toy_kitti: Path, tmp_path: Path) -> None:
    """From the times of finished jobs: 98 s, 2 s per step, 0.5 s per val frame."""
    bench = make_bench(tmp_path, toy_kitti, steps=60)
    write_result(tmp_path, synthetic_result(Job(0.25, 0), 50.0))
    messages = run(bench, ToyJobs(tmp_path))
    assert messages[1] == "ratio 0.25, seed 0, baseline: about 3.7 min (60 steps, 4 frame passes)"
    assert messages[2].startswith("ratio 0.25, seed 0, baseline: mean 3D AP 13.3")


def test_the_first_cost_is_reported_as_a_guess(toy_kitti: Path, tmp_path: Path) -> None:
    """Nothing has been measured yet."""
    messages = run(make_bench(tmp_path, toy_kitti), ToyJobs(tmp_path))
    assert messages[1].endswith("a rough estimate)")
    assert not any("guess" in line for line in messages[2:])


def test_a_failed_cell_does_not_stop_the_others(toy_kitti: Path, tmp_path: Path) -> None:
    """It gets one line; at the end there is an error with the number of failures."""
    bench = make_bench(tmp_path, toy_kitti, **GRID)
    bad = Job(0.25, 1, "baseline")
    jobs = ToyJobs(tmp_path, lambda job: "out of memory" if job == bad else None)
    messages: list[str] = []
    with pytest.raises(CellsFailed, match="1 of 8 cells failed"):
        run_grid(bench, jobs, 2, messages.append, Silent())
    assert f"{bad}: failed: out of memory" in messages
    assert len(jobs.done) == 12
    again = ToyJobs(tmp_path)
    run(bench, again)
    assert again.done == [bad]


def test_cells_fail_if_their_shared_job_failed(toy_kitti: Path, tmp_path: Path) -> None:
    """Other seeds and ratios continue."""
    bench = make_bench(tmp_path, toy_kitti, **GRID)
    bad = Job(0.25, 0)
    jobs = ToyJobs(tmp_path, lambda job: "no labels" if job == bad else None)
    messages: list[str] = []
    with pytest.raises(CellsFailed, match="2 of 8 cells failed"):
        run_grid(bench, jobs, 1, messages.append, Silent())
    assert f"{bad}: failed (so 2 cells cannot run): no labels" in messages
    assert Job(0.25, 0, "pspsl") not in jobs.done


def test_the_progress_bar_ends_full(toy_kitti: Path, tmp_path: Path) -> None:
    """Also if a job reported too little or failed."""
    from contextlib import contextmanager

    steps: list[int] = []

    class Counting(Silent):
        @contextmanager
        def track(self, what, total):
            yield lambda step, note: steps.append(step)

    bench = make_bench(tmp_path, toy_kitti, **GRID)
    jobs = ToyJobs(tmp_path, lambda job: "bad" if job == Job(0.25, 0) else None)
    with pytest.raises(CellsFailed):
        run_grid(bench, jobs, 2, lambda line: None, Counting())
    assert sum(steps) == 1000
    assert min(steps) >= 0


def test_two_benches_cannot_use_the_same_folder(tmp_path: Path) -> None:
    """The second is rejected until the first has ended."""
    rejected = pytest.raises(WorkspaceError, match="another `curate bench`")
    with alone(tmp_path), rejected, alone(tmp_path):
        pass
    with alone(tmp_path):
        pass


def test_a_failed_process_reports_its_reason_in_one_line(toy_kitti: Path, tmp_path: Path) -> None:
    """The last line of its log and the path of the log; the same for a killed process."""
    bench = make_bench(tmp_path / "bench", toy_kitti)
    broken = toy_kitti / "training" / "label_2"
    broken.rename(broken.with_name("label_3"))
    reason = JobProcesses(bench.root)(Job(0.25, 0), lambda kind, units: None)
    assert reason is not None
    assert "label file" in reason
    assert reason.endswith("logs/ratio-0.25-seed-0.log")
    assert "\n" not in reason

    jobs = JobProcesses(bench.root)
    killer = threading.Timer(0.05, jobs.end)
    killer.start()
    reason = jobs(Job(0.25, 0), lambda kind, units: None)
    killer.join()
    assert reason is not None
    assert signal.SIGKILL.name in reason or reason == "interrupted"
