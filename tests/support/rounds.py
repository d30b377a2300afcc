"""Stages and rounds, run serially and without progress output."""

from typing import Any

from pipelines.engine.executors.serial import SerialExecutor
from pipelines.engine.runner import Report, run_frames, run_round
from pipelines.engine.schedule import run_all
from pipelines.engine.stage import RoundStage
from pipelines.round import graph_of, open_plan
from pipelines.workspace.workspace import Workspace
from support.silent import Silent


def run_workspace(workspace: Workspace, rounds: int | None = None, **options: Any) -> list[Report]:
    """Bring every stage up to date, as `curate run` does."""
    return list(run_all(workspace, graph_of(workspace), rounds, Silent(), **options))


def run(workspace: Workspace) -> dict[str, int]:
    """Run everything; return the number of frames (or round stages) done, by stage."""
    return {report.stage: report.done for report in run_workspace(workspace)}


def run_stage(
    workspace: Workspace, name: str, number: int | None = 1, policy: str = "pspsl"
) -> Report:
    """Run one stage of a round."""
    plan = open_plan(workspace, number)
    if isinstance(plan.graph.stage(name), RoundStage):
        return run_round(plan, name, policy, Silent())
    return run_frames(plan, plan.graph.frames_stage(name), SerialExecutor(), Silent())


def state_of(workspace: Workspace, name: str, policy: str = "pspsl", number: int = 1) -> str:
    """Return the state of a round stage."""
    plan = open_plan(workspace, number)
    return plan.round_state(plan.graph.round_stage(name), policy)
