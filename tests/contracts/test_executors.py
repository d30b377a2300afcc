"""The contract of every registered executor."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from contracts.samples import assert_one_line
from support.frame_functions import Deadly, Square, SquareBatches
from support.rounds import run_workspace
from support.stored_rows import dump
from support.toys import toy_document, write_toy_kitti

from curate.errors import CurateError, ModelError
from pipelines.engine.executors.auto import AutoExecutor
from pipelines.engine.executors.base import (
    Executor,
    FrameJob,
    Job,
    JobQueue,
    Outcome,
    batches_for,
)
from pipelines.engine.executors.serial import SerialExecutor
from pipelines.registry import EXECUTORS
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace


@pytest.fixture(scope="module")
def missing_ray() -> Iterator[str]:
    """Return why no Ray cluster can be started, or "" if there is one, which all tests share."""
    try:
        first = EXECUTORS.build("ray", offered={"workers": lambda: 3}, options={})
    except CurateError as error:
        yield str(error)
    else:
        yield ""
        first.close()


def skip_absent(name: str, request: pytest.FixtureRequest) -> None:
    """Skip the test of an executor that cannot run here, with the reason."""
    if name == "ray" and (reason := request.getfixturevalue("missing_ray")):
        pytest.skip(reason)


@pytest.fixture(scope="module", params=sorted(EXECUTORS.classes))
def executor(request: pytest.FixtureRequest) -> Iterator[Executor]:
    """Return every registered executor, with two workers if it has workers."""
    skip_absent(request.param, request)
    made = EXECUTORS.build(request.param, offered={"workers": lambda: 2}, options={})
    yield made
    made.close()


@pytest.fixture
def crew(executor: Executor) -> Executor:
    """Return an executor that survives the death of its workers."""
    if isinstance(executor, SerialExecutor | AutoExecutor):
        pytest.skip("it works in this very process, AutoExecutor at least at first")
    return executor


JOBS = [FrameJob(key, f"{key:06d}") for key in range(50)]


def test_every_job_has_one_outcome(executor: Executor) -> None:
    """The outcome is rows or a one-line error; none is lost or doubled."""
    found = list(executor.map(Square(), iter(JOBS)))
    outcomes = {outcome.job.frame_id: outcome for outcome in found}
    assert sorted(outcome.job.frame_id for outcome in found) == list(range(50))
    for key, outcome in outcomes.items():
        if key % 7 == 3:
            assert outcome.rows == ()
            assert outcome.error == f"frame {key:06d}: ValueError: three lines {key} long"
        else:
            assert (outcome.rows, outcome.error) == (({"squares": {"value": [key**2]}},), None)


def test_a_model_that_cannot_load_ends_the_run_with_its_own_message(executor: Executor) -> None:
    with pytest.raises(ModelError, match=r"model.onnx: broken"):
        list(executor.map(Square(broken=True), iter(JOBS)))


def test_jobs_are_taken_lazily(executor: Executor) -> None:
    """An endless list of frames does not fill the memory."""
    taken = 0

    def endless() -> Iterator[FrameJob]:
        nonlocal taken
        while True:
            taken += 1
            yield FrameJob(taken, str(taken))

    outcomes = executor.map(Square(), endless())
    for _ in range(10):
        next(outcomes)
    assert taken < 40


def test_an_abandoned_run_does_not_affect_the_next(executor: Executor) -> None:
    """Neither its outcomes nor its models remain."""
    abandoned = executor.map(Deadly(), iter(JOBS))
    next(abandoned)
    abandoned.close()
    found = list(executor.map(Square(), iter(JOBS[:4])))
    assert sorted(outcome.job.frame_id for outcome in found) == [0, 1, 2, 3]
    assert [outcome.error is None for outcome in found].count(False) == 1


def test_without_jobs_there_are_no_outcomes(executor: Executor) -> None:
    assert list(executor.map(Square(), iter([]))) == []


def test_the_frame_of_a_killed_worker_is_retried(crew: Executor, tmp_path: Path) -> None:
    """SIGKILL, as the kernel sends it when memory runs out; every frame is done."""
    found = list(crew.map(Deadly(folder=tmp_path, once=(0, 7, 8, 31)), iter(JOBS)))
    assert sorted(outcome.job.frame_id for outcome in found) == list(range(50))
    assert {outcome.error for outcome in found} == {None}
    assert len(list(tmp_path.iterdir())) == 4


def test_only_the_frame_that_kills_its_workers_fails(crew: Executor, tmp_path: Path) -> None:
    """It is tried twice, then recorded as failed with the reason."""
    found = list(crew.map(Deadly(folder=tmp_path, always=(5, 6)), iter(JOBS)))
    assert sorted(outcome.job.frame_id for outcome in found) == list(range(50))
    failed = {outcome.job.frame_id: outcome for outcome in found if outcome.error is not None}
    assert sorted(failed) == [5, 6]
    assert failed[5].rows == ()
    assert failed[5].error.startswith("frame 000005: its worker died 2 times, ")
    assert_one_line(Exception(failed[5].error))


def test_a_suspect_frame_crashes_its_worker_alone(
    crew: Executor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No result of another frame can be lost with it, so that it alone is to blame."""
    in_flight: list[list[int]] = []
    record = JobQueue.record_crash

    def watched(queue: JobQueue, jobs: list[Job], reason: str, **how: bool) -> Iterator[Outcome]:
        in_flight.append([job.frame_id for job in jobs])
        yield from record(queue, jobs, reason, **how)

    monkeypatch.setattr(JobQueue, "record_crash", watched)
    list(crew.map(Deadly(folder=tmp_path, always=(5, 6, 20)), iter(JOBS)))
    last = {jobs[0]: jobs for jobs in in_flight}
    assert {key: last[key] for key in (5, 6, 20)} == {5: [5], 6: [6], 20: [20]}


def batch_outcomes(executor: Executor, function: SquareBatches) -> dict[int, str | list]:
    """Return the row or the error of each frame."""
    found = list(executor.map(function, batches_for(function, JOBS)))
    assert sorted(outcome.job.frame_id for outcome in found) == list(range(50))
    return {
        outcome.job.frame_id: outcome.error or [rows["squares"]["value"] for rows in outcome.rows]
        for outcome in found
    }


def test_a_frame_of_a_batch_fails_alone(executor: Executor, tmp_path: Path) -> None:
    """With an error of its own, or after its batch was halved until only it was left."""
    found = batch_outcomes(executor, SquareBatches(tmp_path))
    for key, result in found.items():
        if key % 7 == 3:
            assert result == f"frame {key:06d}: ValueError: a batch is spoilt"
        else:
            assert result == (f"frame {key}: empty" if key % 7 == 4 else [[key**2]])
    sizes = [int(path.name.split("-")[1]) for path in tmp_path.iterdir()]
    assert max(sizes) == 8
    assert len(sizes) < 50 + 7 * 6  # seven batches, each with one frame that spoils it


def test_only_the_frame_of_a_batch_that_kills_its_workers_fails(
    crew: Executor, tmp_path: Path
) -> None:
    """The batch of a killed worker is halved, and the frame is tried twice alone."""
    found = batch_outcomes(crew, SquareBatches(tmp_path, deadly=(12,), batch_size=16))
    assert found[12].startswith("frame 000012: its worker died 2 times, ")
    wrong = [
        key for key, result in found.items() if isinstance(result, str) and key % 7 not in (3, 4)
    ]
    assert wrong == [12]


def test_a_function_can_limit_its_workers(executor: Executor, tmp_path: Path) -> None:
    """One for a command that needs the whole GPU."""
    function = SquareBatches(tmp_path, batch_size=2, workers=1)
    batch_outcomes(executor, function)
    processes = {path.read_text() for path in tmp_path.iterdir()}
    assert len(processes) == 1


def test_workers_that_die_while_loading_end_the_run(crew: Executor) -> None:
    """A model that does not fit into memory is not loaded again for every frame."""
    with pytest.raises(CurateError, match=r"died while they loaded their models.*fewer workers"):
        list(crew.map(Deadly(opening=True), iter(JOBS)))


@pytest.fixture(scope="module")
def serial_rows(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[tuple]]:
    """Return a toy dataset, and the rows of all stages as one process makes them in order."""
    home = tmp_path_factory.mktemp("executors")
    write_toy_kitti(home / "kitti", frames=24, val=2)
    (home / "detector.txt").write_text("000007")  # the detector raises on this frame
    return home, dump(finished(home, "reference", "serial", 1))


def finished(home: Path, name: str, executor: str, workers: int) -> Workspace:
    """Return a workspace in which all stages have run."""
    document = toy_document(home / "kitti", home / "detector.txt")
    document["run"] = {"executor": executor, "workers": workers}
    workspace = initialise(home / name, make_config(document, "test"), "0.1", "")
    run_workspace(workspace)
    return workspace


@pytest.mark.parametrize(
    ("name", "workers"),
    [
        *((name, workers) for name in sorted(EXECUTORS.classes) for workers in (1, 3)),
        ("support.frame_functions:Shuffled", 1),
    ],
)
def test_the_rows_depend_only_on_the_seed(
    serial_rows: tuple[Path, list[tuple]],
    tmp_path: Path,
    request: pytest.FixtureRequest,
    name: str,
    workers: int,
) -> None:
    """Executor, number of workers and order of frames make no difference to the bit."""
    skip_absent(name, request)
    home, rows = serial_rows
    assert sum(row[0] == "weight" for row in rows) > 50
    assert dump(finished(home, f"{tmp_path.name}", name, workers)) == rows
