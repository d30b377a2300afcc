"""Shared code of the commands that run a single stage."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.commands.dry_run import print_preview
from pipelines.commands.options import end, open_workspace
from pipelines.reports.terminal import print_report

if TYPE_CHECKING:
    from pipelines.engine.graph import Graph
    from pipelines.engine.runner import Report
    from pipelines.engine.stage import RoundStage
    from pipelines.workspace.workspace import Workspace


def run_frame_command(
    stages: Sequence[str] | None,
    folder: Path | None,
    round_number: int | None,
    split: str,
    executor: str | None,
    workers: int | str | None,
    *,
    as_json: bool,
    dry_run: bool = False,
) -> None:
    """Run stages of frames on a split.

    Args:
        stages: names of the stages; None for those of the configured priors.
        folder: see `WorkspaceOption`.
        round_number: None for the first round without a student; 0 for stages of no round.
        split: the split of the frames.
        executor: None for the configured one.
        workers: None for the configured number.
        as_json: whether to print JSON.
        dry_run: whether to print only what would run.
    """
    from curate.errors import ConfigError
    from pipelines.assembly import check_executor
    from pipelines.category_names import check_names
    from pipelines.engine.plan import Plan
    from pipelines.engine.preview import Preview
    from pipelines.engine.progress import Bar
    from pipelines.engine.rounds import open_round, outside_rounds, preview_round
    from pipelines.engine.runner import (
        check_claims,
        check_earlier_stages,
        check_inputs,
        open_executor,
        run_frames,
    )
    from pipelines.round import graph_of
    from pipelines.workspace.splits import SPLITS

    workspace = open_workspace(folder, executor, workers)
    priors = workspace.config.run.priors
    if split not in SPLITS:
        raise ConfigError(f"--split {split}: use one of {', '.join(SPLITS)}")
    names = priors if stages is None else stages
    graph = graph_of(workspace)
    unknown = [name for name in names if name not in {each.name for each in graph.frames_stages}]
    if unknown:
        raise ConfigError(f"--prior {unknown[0]}: not in run.priors {list(priors)}")
    check_executor(workspace.config)
    check_names(workspace)
    selected = [graph.frames_stage(name) for name in names]
    for stage in selected:
        if stage.check:
            stage.check(workspace)
    if dry_run:
        outside = outside_rounds(workspace)
        context = outside if round_number == 0 else preview_round(workspace, round_number)
        context = replace(context, split=split)
        plan = Plan(workspace, context, graph)
        check_inputs(plan, selected, split)
        check_earlier_stages(plan, selected, split)
        preview = Preview(workspace, graph, context.number, context)
        planned = (preview.frames_stage(stage, split, alone=True) for stage in selected)
        print_preview(planned, as_json=as_json)
        return
    if round_number == 0:
        plan = Plan(workspace, outside_rounds(workspace), graph)
    else:
        context = replace(open_round(workspace, round_number), split=split)
        plan = Plan(workspace, context, graph)
    check_inputs(plan, selected, split)
    check_claims(plan, selected)
    check_earlier_stages(plan, selected, split)
    reports = []
    with open_executor(workspace) as work:
        for stage in selected:
            reports.append(run_frames(plan, stage, work, Bar(), split))
            if not as_json:
                print_report(reports[-1])
    end(reports, as_json=as_json)


def run_round_command(
    name: str,
    workspace: "Workspace",
    round_number: int | None,
    policy: str | None,
    *,
    as_json: bool,
    dry_run: bool = False,
    missing: tuple[str, ...] = (),
) -> None:
    """Run a stage of a round for a policy; None for the configured policy.

    Args:
        name: name of the stage.
        workspace: the workspace.
        round_number: None for the first round without a student.
        policy: None for the configured policy.
        as_json: whether to print JSON.
        dry_run: whether to print only what would run.
        missing: failed frames that the export lacks, also if it is up to date.
    """
    from pipelines.category_names import check_names
    from pipelines.engine.plan import Plan
    from pipelines.engine.preview import Preview
    from pipelines.engine.progress import Bar
    from pipelines.engine.rounds import open_round, preview_round
    from pipelines.engine.runner import open_executor, run_round
    from pipelines.engine.truth import run_truth
    from pipelines.round import graph_of

    chosen = policy or workspace.config.run.method
    graph = graph_of(workspace)
    stage = graph.round_stage(name)
    if stage.check:
        stage.check(workspace, chosen)
    if stage.truth:
        _check_truth(workspace, graph, stage, chosen, round_number)
    check_names(workspace)
    if dry_run:
        context = preview_round(workspace, round_number)
        plan = Plan(workspace, context, graph)
        plan.require(stage, chosen)
        if stage.truth is None:
            plan.frames_to_weight(stage, chosen)
        preview = Preview(workspace, graph, context.number, context)
        planned = [*preview.truth(stage, chosen), preview.round_stage(stage, chosen)]
        print_preview(planned, as_json=as_json)
        return
    plan = Plan(workspace, open_round(workspace, round_number), graph)
    reports: list[Report] = []

    def show(report: "Report") -> None:
        reports.append(report)
        if not as_json:
            print_report(report)

    if stage.truth:
        with open_executor(workspace) as work:
            for each in run_truth(plan, stage, chosen, work, Bar()):
                show(each)
    report = run_round(plan, name, chosen, Bar())
    show(replace(report, missing=report.missing or missing))
    end(reports, as_json=as_json)


def _check_truth(
    workspace: "Workspace",
    graph: "Graph",
    stage: "RoundStage",
    policy: str,
    round_number: int | None,
) -> None:
    """Check that a stage has frames with ground truth, and the stages that make their labels."""
    from curate.errors import ConfigError
    from pipelines.assembly import check_executor
    from pipelines.engine.rounds import choose_round

    if not stage.is_part(workspace, policy):
        raise ConfigError(f"policy {policy} does not need `curate {stage.command}`")
    check_executor(workspace.config)
    if stage.check_truth:
        stage.check_truth(workspace, policy, [choose_round(workspace, round_number, None)[0]])
    for each in (*graph.first_stages, *graph.before(stage)):
        if each.check:
            each.check(workspace)
