"""The round as a DAG on one screen; a stage depends on those that write what it reads."""

from collections.abc import Sequence

from pipelines.engine.stage import FrameStage, RoundStage, Stage
from pipelines.registry import PRIORS
from pipelines.stages import export, predict, repredict, score, solve, train_round

_DETECT: tuple[Stage, ...] = (
    FrameStage(
        "predict",
        command="predict",
        reads=("frame", "teacher"),
        writes=("prediction",),
        settings=predict.settings,
        function=predict.function,
    ),
    FrameStage(
        "repredict",
        command="repredict",
        reads=("frame", "teacher", "prediction"),
        writes=("reprediction_view", "reprediction", "consistency"),
        settings=repredict.settings,
        function=repredict.function,
    ),
)
_DECIDE: tuple[Stage, ...] = (
    RoundStage(
        "solve",
        command="solve",
        reads=("prediction", "consistency", "point_prior", "semantic_prior"),
        writes=("weight",),
        settings=solve.settings,
        run=solve.run,
    ),
    RoundStage(
        "export",
        command="export",
        reads=("frame", "ground_truth", "weight"),
        writes=("labels.sqlite",),
        settings=export.settings,
        run=export.run,
        file=export.file,
        guard=export.guard,
    ),
    RoundStage(
        "train-round",
        command="train-round",
        reads=("teacher", "labels.sqlite"),
        writes=("student",),
        settings=train_round.settings,
        run=train_round.run,
        file=train_round.file,
        guard=export.guard,
    ),
)
ROUND = (*_DETECT, *map(score.stage, PRIORS.classes), *_DECIDE)


def stage(name: str) -> Stage:
    """The stage of that name, or the one that asks the prior of that name."""
    return next((stage for stage in ROUND if stage.name == name), None) or score.stage(name)


def active(priors: Sequence[str]) -> tuple[Stage, ...]:
    """The stages of a round in which only some priors are asked.

    Raises:
        ConfigError: there is no such prior, or no place for its evidence.
    """
    return (*_DETECT, *score.stages(priors), *_DECIDE)


def frames_before(of: Stage, priors: Sequence[str]) -> tuple[FrameStage, ...]:
    """The active frame stages whose rows a stage needs, directly or through others."""
    stages = active(priors)
    needed = set(of.reads)
    found: list[FrameStage] = []
    for other in reversed(stages[: stages.index(of)]):
        if needed & set(other.writes):
            needed |= set(other.reads)
            if isinstance(other, FrameStage):
                found.insert(0, other)
    return tuple(found)


def unaffected(of: FrameStage, priors: Sequence[str]) -> tuple[str, ...]:
    """The stages whose rows of a frame stay where a stage's own are made anew.

    All that is known of a frame hangs on its predictions and leaves with them. Priors that are
    stored in the same table take each other's place.
    """
    if "prediction" in of.writes:
        return ()
    known = {stage.name: stage for stage in (*ROUND, *active(priors))}
    return tuple(name for name, other in known.items() if not set(of.writes) & set(other.writes))
