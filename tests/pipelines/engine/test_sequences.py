"""Stages that process whole sequences: planned, run and resumed per sequence."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
from sqlalchemy import text
from support.rounds import run_stage
from support.silent import Silent
from support.toys import ToySequences

from curate.errors import ModelError
from pipelines.engine.executors.base import Executor, FrameRows, SequenceJob
from pipelines.engine.executors.process import ProcessExecutor
from pipelines.engine.executors.serial import SerialExecutor
from pipelines.engine.graph import Graph
from pipelines.engine.plan import Plan
from pipelines.engine.runner import Report, run_frames
from pipelines.engine.stage import SequenceStage
from pipelines.round import open_plan
from pipelines.workspace.workspace import Workspace

ENGINES = ("sqlite", "postgresql")


@dataclass
class Lengths:
    """Stores the number of labels in the whole sequence as the points of each label."""

    poisoned: Path

    def open(self) -> None:
        """Do nothing."""

    def __call__(self, job: SequenceJob) -> Sequence[FrameRows]:
        """Return one row per label; a sequence listed in the file fails."""
        if job.name in self.poisoned.read_text().split():
            raise ModelError(f"sequence {job.name}: poisoned")
        assert [frame.frame for frame in job.frames] == sorted(f.frame for f in job.frames)
        total = sum(len(frame.predictions) for frame in job.frames)
        return [
            {
                "point_prior": {
                    "k": list(range(len(frame.predictions))),
                    "points": [total] * len(frame.predictions),
                    "points_threshold": [1.0] * len(frame.predictions),
                    "rho_diff": [1.0] * len(frame.predictions),
                }
            }
            for frame in job.frames
        ]


@pytest.fixture
def poisoned(tmp_path: Path) -> Path:
    """Return a file with the names of sequences that fail."""
    path = tmp_path / "poisoned.txt"
    path.write_text("")
    return path


@pytest.fixture
def sequenced(workspace: Workspace) -> Workspace:
    """Return the toy workspace over a dataset with sequences of three frames."""
    own = workspace.with_settings("dataset", kind="support.toys:ToySequences")
    assert isinstance(own.dataset, ToySequences)
    return own


def plan_with_lengths(workspace: Workspace, poisoned: Path) -> Plan:
    """Return a plan with `predict` and a sequence stage after it."""
    plan = open_plan(workspace, 1)
    stage = SequenceStage(
        "lengths",
        command="score --prior lengths",
        reads=("frame", "prediction"),
        writes=("point_prior",),
        settings=lambda *_: {},
        function=lambda *_: Lengths(poisoned),
    )
    return Plan(workspace, plan.context, Graph((plan.graph.stage("predict"), stage)))


def run_lengths(workspace: Workspace, poisoned: Path, executor: Executor | None = None) -> Report:
    """Run the stage of sequences."""
    plan = plan_with_lengths(workspace, poisoned)
    stage = plan.graph.frames_stage("lengths")
    return run_frames(plan, stage, executor or SerialExecutor(), Silent())


def points(workspace: Workspace) -> dict[str, set[int]]:
    """Return what is stored for each frame."""
    query = text(
        "SELECT f.frame, p.points FROM point_prior AS p JOIN frame AS f ON f.id = p.frame_id"
    )
    found: dict[str, set[int]] = {}
    with workspace.database.reading() as connection:
        for frame, count in connection.execute(query):
            found.setdefault(frame, set()).add(count)
    return found


def expected(workspace: Workspace) -> dict[str, set[int]]:
    """Return the expected rows: 3 labels per frame, times the frames of the sequence."""
    frames = list(workspace.frames("unlabeled"))
    of = {frame: ToySequences.sequence_name(frame) for frame in frames}
    names = list(of.values())
    return {frame: {3 * names.count(of[frame])} for frame in frames}


@pytest.fixture(params=["serial", "process"])
def executor(request: pytest.FixtureRequest) -> Iterator[Executor]:
    """Return every executor that is always available."""
    made = SerialExecutor() if request.param == "serial" else ProcessExecutor(2)
    yield made
    made.close()


def test_a_stage_sees_whole_sequences(
    sequenced: Workspace, poisoned: Path, executor: Executor
) -> None:
    """Each label gets a value that depends on the whole sequence; a second run does nothing."""
    run_stage(sequenced, "predict")
    first = run_lengths(sequenced, poisoned, executor)
    assert (first.done, first.failed, first.labels) == (6, 0, 18)
    assert points(sequenced) == expected(sequenced)
    again = run_lengths(sequenced, poisoned, executor)
    assert (again.done, again.kept) == (0, 6)


def test_only_the_failed_sequence_is_tried_again(sequenced: Workspace, poisoned: Path) -> None:
    """All its frames are recorded as failed; the other sequences are done."""
    run_stage(sequenced, "predict")
    frames = list(sequenced.frames("unlabeled"))
    bad = ToySequences.sequence_name(frames[0])
    members = [frame for frame in frames if ToySequences.sequence_name(frame) == bad]
    poisoned.write_text(bad)
    first = run_lengths(sequenced, poisoned)
    assert [frame for frame, _ in first.errors] == members
    assert {error for _, error in first.errors} == {f"sequence {bad}: poisoned"}
    assert first.done == 6 - len(members)
    poisoned.write_text("")
    assert run_lengths(sequenced, poisoned).done == len(members)
    assert points(sequenced) == expected(sequenced)


def test_a_sequence_is_processed_again_when_a_missing_frame_arrives(
    sequenced: Workspace, poisoned: Path, weights_file: Path
) -> None:
    """A frame that failed before is left out; once it succeeds, its sequence is stale."""
    late = next(iter(sequenced.frames("unlabeled")))
    weights_file.write_text(late)
    run_stage(sequenced, "predict")
    assert run_lengths(sequenced, poisoned).done == 5
    assert late not in points(sequenced)
    weights_file.write_text("")
    run_stage(sequenced, "predict")
    assert run_lengths(sequenced, poisoned).done == 6
    assert points(sequenced) == expected(sequenced)


def test_new_predictions_of_one_frame_make_its_whole_sequence_stale(
    sequenced: Workspace, poisoned: Path
) -> None:
    """The rows of its neighbours depend on the old predictions."""
    run_stage(sequenced, "predict")
    run_lengths(sequenced, poisoned)
    frames = sequenced.frames("unlabeled")
    name, key = next(iter(frames.items()))
    with sequenced.database.writing() as connection:
        connection.execute(
            text("DELETE FROM task WHERE stage = 'predict' AND frame_id = :key"), {"key": key}
        )
    run_stage(sequenced, "predict")
    sequence = ToySequences.sequence_name(name)
    members = [each for each in frames if ToySequences.sequence_name(each) == sequence]
    assert run_lengths(sequenced, poisoned).done == len(members)
