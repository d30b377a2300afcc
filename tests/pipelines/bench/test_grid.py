"""The jobs of a grid: order, remaining jobs, work and cost."""

import io
import json
from pathlib import Path

import pytest
from support.bench_results import make_bench, synthetic_result

from pipelines.bench.costs import FIRST_GUESS, OVERHEAD_S, Costs
from pipelines.bench.grid import Job, Sizes, jobs, waiting, work
from pipelines.bench.metered import Metered
from pipelines.bench.results import read_result, read_results, write_result
from pipelines.bench.settings import Axes

AXES = Axes(methods=("baseline", "pspsl"), ratios=(0.1, 0.5), seeds=(0, 1))


def test_shared_jobs_come_before_the_cells_that_need_them() -> None:
    """A seed is finished before the next one starts."""
    order = jobs(AXES)
    assert len(order) == 2 * 2 * (1 + 2)
    assert order[:3] == [Job(0.1, 0), Job(0.1, 0, "baseline"), Job(0.1, 0, "pspsl")]
    assert [job.seed for job in order] == sorted(job.seed for job in order)
    for job in order:
        assert order.index(job.shared) <= order.index(job)


def test_every_job_has_its_own_folder(tmp_path: Path) -> None:
    """Cells are separate from what they share."""
    folders = {job.folder(tmp_path) for job in jobs(AXES)}
    assert len(folders) == len(jobs(AXES))
    assert Job(0.1, 0, "pspsl").folder(tmp_path) == tmp_path / "cells" / "ratio-0.1-seed-0-pspsl"


def test_finished_jobs_are_not_pending(tmp_path: Path) -> None:
    """Nor is a shared job if all its cells are finished."""
    done = Job(0.1, 0, "pspsl")
    write_result(tmp_path, synthetic_result(done, 50.0))
    left = waiting(AXES, tmp_path)
    assert done not in left
    assert Job(0.1, 0) in left
    write_result(tmp_path, synthetic_result(Job(0.1, 0, "baseline"), 50.0))
    assert Job(0.1, 0) not in waiting(AXES, tmp_path)


def test_a_stored_result_is_read_back_unchanged(tmp_path: Path) -> None:
    """Undefined values included."""
    for job in (Job(0.5, 0, "pspsl"), Job(0.1, 1), Job(0.1, 0, "baseline")):
        write_result(tmp_path, synthetic_result(job, 60.0))
        assert read_result(tmp_path, job) == synthetic_result(job, 60.0)
    assert [result.job.ratio for result in read_results(tmp_path)] == [0.1, 0.1, 0.5]


def test_the_work_of_a_job(toy_kitti: Path, tmp_path: Path) -> None:
    """The frames of round 1 belong to the shared job, those of later rounds to the cell."""
    bench = make_bench(tmp_path, toy_kitti, steps=7, rounds=3)
    sizes = Sizes(train=8, val=4)
    shared = work(Job(0.25, 0), bench.config(0), sizes)
    assert shared == {"train": 7, "predict": 6, "repredict": 6, "points": 6, "evaluate": 4}
    cell = work(Job(0.25, 0, "pspsl"), bench.config(0, "pspsl"), sizes)
    assert cell == {"train": 21, "predict": 12, "repredict": 12, "points": 12, "evaluate": 4}
    longer = make_bench(tmp_path / "longer", toy_kitti, steps=7, teacher_steps=20, rounds=3)
    assert work(Job(0.25, 0), longer.config(0), sizes)["train"] == 20
    assert work(Job(0.25, 0, "pspsl"), longer.config(0, "pspsl"), sizes)["train"] == 21
    alone = work(Job(0.25, 0, "baseline"), bench.config(0, "baseline"), sizes)
    assert alone == {"train": 21, "predict": 0, "repredict": 0, "points": 0, "evaluate": 4}


def test_costs_are_estimated_from_measured_times() -> None:
    """A first guess, then 2 s per step, then the mean over both jobs: (20 + 40) s / 20 steps."""
    costs = Costs()
    assert costs.seconds({"train": 10}) == OVERHEAD_S + 10 * FIRST_GUESS["train"]
    assert not costs.measured
    # 120 s, with 20 s of steps and 2 s of frames: 98 s of overhead.
    costs.learn(synthetic_result(Job(0.1, 0), 50.0))
    assert costs.measured
    assert costs.seconds({"train": 10, "evaluate": 2}) == pytest.approx(98 + 20 + 1)
    costs.learn(synthetic_result(Job(0.1, 1), 50.0, timings={"train": (10, 40.0)}, seconds=42.0))
    assert costs.rate("train") == 3.0
    assert costs.seconds({"train": 10}) == pytest.approx((98 + 2) / 2 + 30)
    assert costs.rate("predict") == FIRST_GUESS["predict"]


def test_a_job_reports_its_units_by_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    """A training is identified by its checkpoint; the first units are not measured."""
    clock = iter([0.0, 1.0, 3.0, 5.0, 5.0, 10.0, 11.0, 12.0])
    monkeypatch.setattr("pipelines.bench.metered.time.monotonic", lambda: next(clock))
    stream = io.StringIO()
    metered = Metered(stream)
    with metered.track("round-01-pspsl", 10) as advance:
        for units in (6, 2, 2):  # six of them are from an earlier run
            advance(units, "")
    with metered.track("predict", 3) as advance:
        advance(3, "")
    messages = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert sum(line["units"] for line in messages if line["kind"] == "train") == 10
    assert {line["kind"] for line in messages} == {"train", "predict"}
    assert metered.timings["train"] == (4, 4.0)
