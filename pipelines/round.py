"""The round as a DAG on one screen; a stage depends on those that write what it reads."""

from collections.abc import Sequence

from pipelines.stage import FrameStage, RoundStage, Stage
from pipelines.stages import export, points, predict, repredict, semantic, solve, train_round

ROUND: tuple[Stage, ...] = (
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
    FrameStage(
        "points",
        command="score --prior points",
        reads=("frame", "ground_truth", "prediction"),
        writes=("point_prior",),
        settings=points.settings,
        function=points.function,
    ),
    FrameStage(
        "semantic",
        command="score --prior semantic",
        reads=("frame", "prediction"),
        writes=("semantic_prior",),
        settings=semantic.settings,
        function=semantic.function,
    ),
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
    ),
    RoundStage(
        "train-round",
        command="train-round",
        reads=("teacher", "labels.sqlite"),
        writes=("student",),
        settings=train_round.settings,
        run=train_round.run,
        file=train_round.file,
    ),
)
PRIORS = ("points", "semantic")


def stage(name: str) -> Stage:
    """The stage of that name."""
    return next(stage for stage in ROUND if stage.name == name)


def active(priors: Sequence[str]) -> tuple[Stage, ...]:
    """The stages of a round in which only some priors are asked."""
    return tuple(s for s in ROUND if s.name not in PRIORS or s.name in priors)


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
