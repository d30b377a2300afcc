"""Running all stages of all rounds."""

from collections.abc import Iterator
from dataclasses import replace

from pipelines.assembly import check_executor
from pipelines.engine.graph import Graph
from pipelines.engine.plan import Plan
from pipelines.engine.progress import Progress
from pipelines.engine.rounds import is_student_trained, open_round, outside_rounds
from pipelines.engine.runner import (
    Report,
    check_inputs,
    open_executor,
    run_first,
    run_frames,
    run_round,
)
from pipelines.engine.stage import FirstStage, FramesStage, RoundStage
from pipelines.engine.truth import check_truth_inputs, run_truth
from pipelines.workspace.workspace import Workspace


def run_all(
    workspace: Workspace,
    graph: Graph,
    rounds: int | None,
    progress: Progress,
    *,
    train: bool = True,
    evidence: bool = True,
) -> Iterator[Report]:
    """Bring every stage of every round up to date, and yield the report of each when it ends.

    An external detector is trained only by the user's own command (`train.command`). Without one,
    there is a single round without a student.

    Args:
        workspace: the workspace.
        graph: the stages.
        rounds: number E of rounds; None for the configured number.
        progress: shows the progress of each stage.
        train: whether students are trained; without them only the first round can run.
        evidence: whether to run the stages of frames; False only for a policy that uses no
            unlabeled frames.
    """
    trained = train and is_student_trained(workspace)
    policy = workspace.config.run.method
    total = (rounds or workspace.config.run.rounds) if trained else 1
    check_stages(workspace, graph, policy, evidence=evidence, rounds=total)
    for first in graph.first_stages:
        yield run_first(workspace, first, progress)
    with open_executor(workspace) as executor:
        for cache in graph.cache_stages if evidence else ():
            outside = Plan(workspace, outside_rounds(workspace), graph)
            for split in cache.ahead(workspace):
                report = run_frames(outside, cache, executor, progress, split)
                yield replace(report, stage=f"{report.stage} {split}")
        for number in range(1, total + 1):
            plan = Plan(workspace, open_round(workspace, number, rounds), graph)
            if evidence:
                check_inputs(plan, graph.stages)
                check_truth_inputs(plan, policy)
            for stage in graph.stages:
                if isinstance(stage, FramesStage) and evidence:
                    yield run_frames(plan, stage, executor, progress)
                if isinstance(stage, RoundStage) and (trained or "student" not in stage.writes):
                    if not stage.is_part(workspace, policy):
                        continue
                    yield from run_truth(plan, stage, policy, executor, progress)
                    yield run_round(plan, stage.name, policy, progress)


def check_stages(
    workspace: Workspace, graph: Graph, policy: str, *, evidence: bool = True, rounds: int = 1
) -> None:
    """Check the settings of the executor and of all stages before any of them runs.

    Args:
        workspace: the workspace.
        graph: the stages.
        policy: name of the policy.
        evidence: whether the stages of frames run.
        rounds: number of rounds that will run.

    Raises:
        CurateError: if a setting is wrong.
    """
    check_executor(workspace.config)
    for stage in graph.stages:
        if isinstance(stage, FirstStage):
            stage.check(workspace)
        if isinstance(stage, RoundStage) and stage.is_part(workspace, policy):
            if stage.check:
                stage.check(workspace, policy)
            if stage.check_truth:
                stage.check_truth(workspace, policy, range(1, rounds + 1))
        if evidence and isinstance(stage, FramesStage) and stage.check:
            stage.check(workspace)
