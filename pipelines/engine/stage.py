"""The types of stages. A stage is a named step that reads some tables and writes others."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from sqlalchemy import Connection

from curate.priors.base import Measured
from curate.weighting.base import Age
from pipelines.engine.executors.base import BatchFunction, FrameFunction, SequenceFunction
from pipelines.engine.progress import Progress
from pipelines.workspace.workspace import Workspace

Settings = Mapping[str, Any]


@dataclass(frozen=True)
class Teacher:
    """The detector that predicts in a round.

    Attributes:
        path: its checkpoint, or the file or folder that the user supplied; None for a command
            without one.
        sha256: hash of that file or folder; "" without one.
    """

    path: Path | None
    sha256: str


@dataclass(frozen=True)
class RoundContext:
    """A round and its teacher.

    Attributes:
        number: number e of the round, from 1; 0 for work that depends on no round.
        rounds: number E of rounds.
        seed: seed of the workspace.
        teacher: the detector that predicts.
        split: split of the frames on which the stages of frames work.
    """

    number: int
    rounds: int
    seed: int
    teacher: Teacher
    split: str = "unlabeled"

    @property
    def age(self) -> Age:
        """Number of the round and number of rounds, for the policies."""
        return Age(self.number, self.rounds)


@dataclass(frozen=True)
class RoundJob:
    """The input of a round stage.

    Attributes:
        context: the round.
        policy: name of the policy.
        frames: keys of the unlabeled frames that all earlier stages have finished; none for a stage
            that reads frames with ground truth.
        truth: the frames with ground truth that it reads.
    """

    context: RoundContext
    policy: str
    frames: Sequence[int]
    truth: Sequence["TruthFrames"] = ()


@dataclass(frozen=True)
class Product:
    """The result of a round stage.

    Attributes:
        summary: the result in a few words, for the report.
        write: function that stores its rows, in the transaction that records the stage as done.
        keys_known: see `db.session.Database.writing`.
        missing: failed frames that are not in an export.
    """

    summary: str
    write: Callable[[Connection], None]
    keys_known: bool = False
    missing: tuple[str, ...] = ()


class _TruthSources(Protocol):
    def __call__(
        self, workspace: Workspace, context: RoundContext, policy: str, *, create: bool
    ) -> "Sequence[TruthSource]": ...


@dataclass(frozen=True)
class ReusableMeasurements:
    """How a stage computes its rows from stored measurements, if only the formula has changed.

    Attributes:
        reads: tables or sources that the measurements depend on.
        settings: function that returns the settings that they depend on.
        read: function that returns the measured columns of some frames, by frame key.
        function: what the stage does with a frame's measurements, without reading the frame.
    """

    reads: tuple[str, ...]
    settings: Callable[[Workspace, RoundContext], Settings]
    read: Callable[[Workspace, RoundContext, Sequence[int]], Mapping[int, Measured]]
    function: Callable[[Workspace, RoundContext], FrameFunction]


@dataclass(frozen=True)
class _Stage:
    """The common part of all stages.

    Attributes:
        name: name of the stage and, with underscores, of its module.
        command: command that runs it.
        reads: tables or sources that its rows depend on.
        writes: tables or files that it writes.
    """

    name: str
    command: str
    reads: tuple[str, ...]
    writes: tuple[str, ...]

    @property
    def results(self) -> tuple[str, ...]:
        """What it writes that other stages depend on."""
        return self.writes


@dataclass(frozen=True, kw_only=True)
class FirstStage(_Stage):
    """A stage that runs once in a workspace, before the first round.

    Attributes:
        settings: function that returns everything that the result depends on.
        run: function that does the work.
        file: function that returns the path of the file it writes.
        check: check of its settings before any work; raises an error.
        guard: check at every start, even if the stage is up to date; raises LeakageError.
    """

    settings: Callable[[Workspace], Any]
    run: Callable[[Workspace, Progress], Product]
    file: Callable[[Workspace], Path]
    check: Callable[[Workspace], None]
    guard: Callable[[Workspace], None]


@dataclass(frozen=True)
class TruthSource:
    """Frames with ground truth whose labels a round stage compares with it.

    Attributes:
        workspace: where their labels are: the workspace of the round, or a fold inside it.
        split: their split there.
        title: what they are, for reports, such as "calibration" or "1/5".
        first: stages that train the teacher of a fold, after those before the first round.
    """

    workspace: Workspace
    split: str
    title: str
    first: tuple[FirstStage, ...] = ()


@dataclass(frozen=True)
class TruthFrames:
    """The frames of a source that all earlier stages have finished.

    Attributes:
        source: the source.
        context: the round, with the teacher of the source.
        frames: keys of the frames, in the workspace of the source.
        fingerprints: fingerprints of the stages that made their labels.
    """

    source: TruthSource
    context: RoundContext
    frames: Sequence[int]
    fingerprints: Sequence[str]


@dataclass(frozen=True, kw_only=True)
class _FramesStage(_Stage):
    """The common part of the stages with rows that belong to frames.

    Attributes:
        settings: function that returns the settings that its rows depend on, without those of
            its reusable measurements.
        check: check of its settings before the first frame; raises an error.
        ready: check of the input of a split in a round before the first frame; raises an error.
        prepare: function that creates the tables or the folder it writes to, if missing.
    """

    settings: Callable[[Workspace, RoundContext], Settings]
    check: Callable[[Workspace], None] | None = None
    ready: Callable[[Workspace, RoundContext, str], None] | None = None
    prepare: Callable[[Workspace], None] | None = None


@dataclass(frozen=True, kw_only=True)
class FrameStage(_FramesStage):
    """A stage that processes every frame by itself.

    Attributes:
        function: function that returns what the stage does with a frame, or a batch of frames.
        reusable: how it reuses its stored measurements; None if it has none.
    """

    function: Callable[[Workspace, RoundContext], FrameFunction | BatchFunction]
    reusable: ReusableMeasurements | None = None


@dataclass(frozen=True, kw_only=True)
class CacheStage(_FramesStage):
    """A stage that makes ahead, once per frame, what later stages would make themselves.

    It depends on no round: its tasks are those of round 0. As its readers get the same with or
    without it, no stage waits for it, and no fingerprint depends on it. In a round it processes
    only frames that one of its readers will read.

    Attributes:
        function: function that returns what the stage does with a frame. That returns an entry for
            what was stored; without one, the frame is not done.
        refusal: function that returns a function, which returns why nothing further can be stored;
            "" if it can. The stage then ends early.
        exists: function that returns whether the folder of what it stored is there.
    """

    function: Callable[[Workspace, RoundContext], FrameFunction]
    refusal: Callable[[Workspace], Callable[[], str]]
    exists: Callable[[Workspace], bool]

    @property
    def results(self) -> tuple[str, ...]:
        """Nothing: no result depends on a cache."""
        return ()


@dataclass(frozen=True, kw_only=True)
class SequenceStage(_FramesStage):
    """A stage that processes all frames of a sequence together.

    It is planned and resumed per sequence. A frame without a sequence forms one by itself. Frames
    that failed in an earlier stage are left out.

    Attributes:
        function: function that returns what the stage does with a sequence.
    """

    function: Callable[[Workspace, RoundContext], SequenceFunction]


@dataclass(frozen=True, kw_only=True)
class RoundStage(_Stage):
    """A stage that processes all labels of a round at once, for one policy.

    Attributes:
        settings: function that returns the settings that its result depends on; the last argument
            is the policy.
        run: function that does the work.
        file: function that returns the path of the file it writes; None if it writes none.
        guard: check at every start, even if the stage is up to date; raises LeakageError.
        needs: round stages that must be up to date for the same policy before this one runs.
        check: check of its settings before any work; raises an error.
        applies: function that returns whether the stage is part of a round under a policy; None if
            it always is.
        truth: function that returns the frames with ground truth that the stage reads instead of
            unlabeled frames; None if it reads none. With `create`, folds are created; otherwise it
            raises WorkspaceError if one is missing.
        check_truth: check that there are such frames in some rounds, before any work; raises an
            error.
    """

    settings: Callable[[Workspace, RoundContext, str], Settings]
    run: Callable[[Workspace, RoundJob, Progress], Product]
    file: Callable[[Workspace, RoundContext, str], Path] | None = None
    guard: Callable[[Workspace, RoundContext, str], None] | None = None
    needs: tuple[str, ...] = ()
    check: Callable[[Workspace, str], None] | None = None
    applies: Callable[[Workspace, str], bool] | None = None
    truth: _TruthSources | None = None
    check_truth: Callable[[Workspace, str, Iterable[int]], None] | None = None

    def is_part(self, workspace: Workspace, policy: str) -> bool:
        """Return whether the stage is part of a round under a policy."""
        return self.applies is None or self.applies(workspace, policy)


FramesStage = FrameStage | CacheStage | SequenceStage
"""A stage that processes frames."""
Stage = FirstStage | FramesStage | RoundStage
