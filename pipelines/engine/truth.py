"""Labels of frames with ground truth, which a round stage compares with it.

They are made by the same stages as those of unlabeled frames, right before the round stage.
"""

from collections.abc import Iterator
from dataclasses import replace

from pipelines.engine.executors.base import Executor
from pipelines.engine.plan import Plan
from pipelines.engine.progress import Progress
from pipelines.engine.rounds import open_round
from pipelines.engine.runner import Report, check_inputs, run_first, run_frames
from pipelines.engine.stage import RoundStage, TruthSource


def run_truth(
    plan: Plan, stage: RoundStage, policy: str, executor: Executor, progress: Progress
) -> Iterator[Report]:
    """Bring the labels that a round stage compares with ground truth up to date.

    Yields:
        The report of each stage, with the title of the frames.
    """
    if stage.truth is not None:
        for source in stage.truth(plan.workspace, plan.context, policy, create=True):
            for report in _run_source(plan, source, executor, progress):
                yield replace(report, stage=f"{report.stage} {source.title}")


def _run_source(
    plan: Plan, source: TruthSource, executor: Executor, progress: Progress
) -> Iterator[Report]:
    if source.workspace is not plan.workspace:
        for first in (*plan.graph.first_stages, *source.first):
            yield run_first(source.workspace, first, progress)
        open_round(source.workspace, plan.context.number, plan.context.rounds)
    labels = plan.of_source(source)
    check_inputs(labels, plan.graph.frames_stages, source.split)
    for stage in plan.graph.frames_stages:
        yield run_frames(labels, stage, executor, progress, source.split)
