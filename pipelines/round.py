"""The graph of a round. A stage depends on the stages that write the tables it reads."""

from collections.abc import Sequence
from dataclasses import replace

from pipelines.assembly import stores_maps
from pipelines.engine.graph import Graph
from pipelines.engine.plan import Plan
from pipelines.engine.rounds import is_pretrained, is_student_trained, open_round
from pipelines.engine.stage import CacheStage, FirstStage, FrameStage, RoundStage, Stage
from pipelines.stages import (
    calibrate,
    calibration_frames,
    export,
    predict,
    pretrain,
    repredict,
    score,
    segment,
    solve,
    train_round,
)
from pipelines.stages.copies import check_copies
from pipelines.workspace.config import DEFAULT_PRIORS
from pipelines.workspace.workspace import Workspace

_FIRST = (
    FirstStage(
        "pretrain",
        command="pretrain",
        reads=("frame", "ground_truth"),
        writes=("teacher",),
        settings=pretrain.settings,
        run=pretrain.run,
        file=pretrain.file,
        check=pretrain.check,
        guard=pretrain.guard,
    ),
)
_SEGMENT = (
    CacheStage(
        "segment",
        command="segment",
        reads=("frame",),
        writes=("maps",),
        settings=segment.settings,
        function=segment.function,
        check=segment.check,
        refusal=segment.refusal,
        prepare=segment.prepare,
        exists=segment.exists,
    ),
)
_DETECT = (
    FrameStage(
        "predict",
        command="predict",
        reads=("frame", "teacher"),
        writes=("prediction",),
        settings=predict.settings,
        function=predict.function,
        check=predict.check,
    ),
    FrameStage(
        "repredict",
        command="repredict",
        reads=("frame", "teacher", "prediction"),
        writes=("reprediction_view", "reprediction", "consistency"),
        settings=repredict.settings,
        function=repredict.function,
        check=predict.check,
        ready=check_copies,
    ),
)
_JUDGE = (
    RoundStage(
        "calibrate",
        command="calibrate",
        reads=("ground_truth", "prediction", "consistency"),
        writes=("calibration",),
        settings=calibrate.settings,
        run=calibrate.run,
        applies=calibrate.applies,
        truth=calibration_frames.truth,
        check_truth=calibration_frames.check_truth,
    ),
    RoundStage(
        "solve",
        command="solve",
        reads=("prediction", "consistency", "calibration"),
        writes=("weight",),
        settings=solve.settings,
        run=solve.run,
        check=solve.check,
        needs=("calibrate",),
    ),
)
_TRAIN = (
    RoundStage(
        "export",
        command="export",
        reads=("frame", "ground_truth", "weight"),
        writes=("labels.sqlite",),
        settings=export.settings,
        run=export.run,
        file=export.file,
        check=solve.check,
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
        check=train_round.check,
        guard=export.guard,
        needs=("export",),
    ),
)


def round_graph(
    priors: Sequence[str] = DEFAULT_PRIORS, *, pretrained: bool = True, maps: bool = True
) -> Graph:
    """Return the graph of a round.

    Args:
        priors: names of the evidence sources, as in run.priors.
        pretrained: whether curate trains the first teacher, so that the graph starts with pretrain.
        maps: whether the segmenter's maps are stored, so that segment makes them ahead.

    Raises:
        ConfigError: if there is no such prior, or its declaration is invalid.
    """
    first: tuple[Stage, ...] = _FIRST if pretrained else ()
    ahead = _SEGMENT if maps and score.reads_maps(priors) else ()
    scores = score.stages(priors, [each for stage in ahead for each in stage.writes])
    evidence = tuple(table for stage in scores for table in stage.writes)
    judging = (replace(stage, reads=(*stage.reads, *evidence)) for stage in _JUDGE)
    return Graph((*first, *ahead, *_DETECT, *scores, *judging, *_TRAIN))


def graph_of(workspace: Workspace) -> Graph:
    """Return the graph of a workspace, see `round_graph`."""
    return round_graph(
        workspace.config.run.priors,
        pretrained=is_pretrained(workspace),
        maps=stores_maps(workspace.config),
    )


def run_graph(workspace: Workspace) -> Graph:
    """Return the stages that a run of a workspace includes, with its trainer and its method."""
    trained, method = is_student_trained(workspace), workspace.config.run.method
    return Graph(
        tuple(
            stage
            for stage in graph_of(workspace).stages
            if (trained or "student" not in stage.writes)
            and (not isinstance(stage, RoundStage) or stage.is_part(workspace, method))
        )
    )


def open_plan(
    workspace: Workspace,
    number: int | None = None,
    rounds: int | None = None,
    split: str = "unlabeled",
) -> Plan:
    """Return the plan of a round for the frames of a split, see `open_round`."""
    context = replace(open_round(workspace, number, rounds), split=split)
    return Plan(workspace, context, graph_of(workspace))
