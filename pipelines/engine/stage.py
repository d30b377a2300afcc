"""What a stage is: a named step that reads some tables and writes others."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection

from curate.priors.base import Measured
from curate.weighting.base import Age
from pipelines.engine.executors.base import FrameFunction, SequenceFunction
from pipelines.engine.progress import Progress
from pipelines.workspace.workspace import Workspace

Settings = Mapping[str, Any]


@dataclass(frozen=True)
class Teacher:
    """The detector that answers in a round.

    Attributes:
        path: its checkpoint, or the file that the user brought.
        sha256: of that file.
    """

    path: Path
    sha256: str


@dataclass(frozen=True)
class RoundContext:
    """Which round it is.

    Attributes:
        number: e, from 1.
        rounds: E.
        seed: of the workspace.
        teacher: see `Teacher`.
    """

    number: int
    rounds: int
    seed: int
    teacher: Teacher

    @property
    def age(self) -> Age:
        """Number and count of rounds, for the policies."""
        return Age(self.number, self.rounds)


@dataclass(frozen=True)
class RoundJob:
    """What a round stage works on.

    Attributes:
        context: the round.
        policy: whose weights.
        frames: keys of the unlabeled frames that all earlier stages have finished.
    """

    context: RoundContext
    policy: str
    frames: Sequence[int]


@dataclass(frozen=True)
class Product:
    """What a round stage has made.

    Attributes:
        summary: what it did, in a few words.
        write: stores its rows, in the transaction that also records the stage as done.
        keys_known: see `db.session.Database.writing`.
    """

    summary: str
    write: Callable[[Connection], None]
    keys_known: bool = False


@dataclass(frozen=True)
class ReusableMeasurements:
    """How a stage goes on from what it once measured, where only the formula has changed.

    Attributes:
        reads: tables or sources; together with `settings` all that its measurements depend on.
        settings: what they depend on beside what it reads.
        read: the measured columns of some frames, by key.
        function: what it does with a frame and its measurements, without looking at the frame.
    """

    reads: tuple[str, ...]
    settings: Callable[[Workspace, RoundContext], Settings]
    read: Callable[[Workspace, RoundContext, Sequence[int]], Mapping[int, Measured]]
    function: Callable[[Workspace, RoundContext], FrameFunction]


@dataclass(frozen=True)
class _Stage:
    """What all stages have.

    Attributes:
        name: of the stage and, with underscores, of its file.
        command: that runs it.
        reads: tables or sources; together with `settings` all that its rows depend on.
        writes: tables or files.
    """

    name: str
    command: str
    reads: tuple[str, ...]
    writes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class FirstStage(_Stage):
    """A stage that is done once in a workspace, before the first round.

    Attributes:
        settings: all that its result depends on.
        run: does it.
        file: what it leaves on disk.
        guard: what must hold at every start, even where the stage is up to date; raises.
    """

    settings: Callable[[Workspace], Any]
    run: Callable[[Workspace, Progress], Product]
    file: Callable[[Workspace], Path]
    guard: Callable[[Workspace], None]


@dataclass(frozen=True, kw_only=True)
class _FramesStage(_Stage):
    """What the stages have whose rows belong to frames.

    Attributes:
        settings: what its rows depend on beside what it reads and recalls.
        check: what can be known before the first frame to be wrong with its settings; raises.
        prepare: makes what it writes to, where that is not there yet.
    """

    settings: Callable[[Workspace, RoundContext], Settings]
    check: Callable[[Workspace], None] | None = None
    prepare: Callable[[Workspace], None] | None = None


@dataclass(frozen=True, kw_only=True)
class FrameStage(_FramesStage):
    """A stage that treats every frame alone.

    Attributes:
        function: what it does with a frame.
        recall: see `Recall`; None where there is nothing that could be kept.
    """

    function: Callable[[Workspace, RoundContext], FrameFunction]
    recall: ReusableMeasurements | None = None


@dataclass(frozen=True, kw_only=True)
class SequenceStage(_FramesStage):
    """A stage that looks at all frames of a sequence together, planned and resumed per sequence.

    A frame of no known sequence is a sequence of its own. Frames that failed before are left out.

    Attributes:
        function: what it does with a sequence.
    """

    function: Callable[[Workspace, RoundContext], SequenceFunction]


@dataclass(frozen=True, kw_only=True)
class RoundStage(_Stage):
    """A stage that looks at all labels of a round at once, for one policy.

    Attributes:
        settings: what its result depends on beside what it reads; the last argument is the policy.
        run: does it.
        file: what it leaves on disk, if anything.
        guard: what must hold at every start, even where the stage is up to date; raises.
        needs: round stages that must be up to date for the same policy before this one runs.
        check: what can be known before any work to be wrong with its settings; raises.
    """

    settings: Callable[[Workspace, RoundContext, str], Settings]
    run: Callable[[Workspace, RoundJob, Progress], Product]
    file: Callable[[Workspace, RoundContext, str], Path] | None = None
    guard: Callable[[Workspace, RoundContext, str], None] | None = None
    needs: tuple[str, ...] = ()
    check: Callable[[Workspace, str], None] | None = None


FramesStage = FrameStage | SequenceStage
"""A stage whose rows belong to frames."""
Stage = FirstStage | FrameStage | SequenceStage | RoundStage
