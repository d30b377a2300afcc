"""What every registered executor promises."""

from dataclasses import dataclass

import pytest

from curate.errors import ModelError
from pipelines.executors.base import FrameJob, FrameRows
from pipelines.registry import EXECUTORS


@dataclass
class Square:
    """Squares the key of a frame; refuses some, cannot even start if told so."""

    broken: bool = False

    def open(self) -> None:
        """Fails where the model is broken."""
        if self.broken:
            raise ModelError("model.onnx: broken")

    def __call__(self, job: FrameJob) -> FrameRows:
        """One row."""
        if job.frame_id % 7 == 3:
            raise ValueError(f"three\nlines {job.frame_id}\nlong")
        return {"squares": [(job.frame_id**2,)]}


@pytest.fixture(scope="module", params=sorted(EXECUTORS.classes))
def executor(request: pytest.FixtureRequest):
    """Every registered executor, with two workers where it has workers."""
    made = EXECUTORS.build(request.param, offered={"workers": lambda: 2}, options={})
    yield made
    made.close()


JOBS = [FrameJob(key, f"{key:06d}") for key in range(50)]


def test_every_job_has_one_outcome(executor) -> None:
    """Rows or an error of one line, never both, none lost, none twice."""
    outcomes = {outcome.job.frame_id: outcome for outcome in executor.map(Square(), iter(JOBS))}
    assert sorted(outcomes) == list(range(50))
    for key, outcome in outcomes.items():
        if key % 7 == 3:
            assert outcome.rows == {}
            assert outcome.error == f"frame {key:06d}: ValueError: three lines {key} long"
        else:
            assert (outcome.rows, outcome.error) == ({"squares": [(key**2,)]}, None)


def test_a_broken_model_ends_the_run_in_its_own_words(executor) -> None:
    """It is no fault of any frame."""
    with pytest.raises(ModelError, match=r"model.onnx: broken"):
        list(executor.map(Square(broken=True), iter(JOBS)))


def test_jobs_are_taken_as_they_are_needed(executor) -> None:
    """An endless list of frames does not fill the memory."""
    taken = 0

    def endless():
        nonlocal taken
        while True:
            taken += 1
            yield FrameJob(taken, str(taken))

    outcomes = executor.map(Square(), endless())
    for _ in range(10):
        next(outcomes)
    assert taken < 40


def test_no_jobs_no_outcomes(executor) -> None:
    """And no complaint."""
    assert list(executor.map(Square(), iter([]))) == []
