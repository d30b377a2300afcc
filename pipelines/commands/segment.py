"""curate segment: make and store the semantic maps of frames."""

from pipelines.commands.options import (
    DryRunOption,
    ExecutorOption,
    JsonOption,
    SplitOption,
    WorkersOption,
    WorkspaceOption,
    end,
    open_workspace,
)
from pipelines.commands.stages import run_frame_command
from pipelines.reports.terminal import print_line


def segment(
    split: SplitOption = "unlabeled",
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Make the semantic map of each image and store it, once for all rounds.

    The stages that need a map read the stored one, and make it if it is missing. So the command
    only makes them ahead, on all cores; it needs no detector.

    Example: curate segment --split unlabeled
    """
    from pipelines.assembly import why_maps_are_not_stored
    from pipelines.engine.runner import Report
    from pipelines.round import graph_of

    opened = open_workspace(workspace)
    if not any(graph_of(opened).cache_stages):
        reason = why_maps_are_not_stored(opened.config)
        reason = reason or "no source in run.priors reads semantic maps"
        report = Report("segment", 0, summary=f"nothing to do: {reason}")
        if not as_json:
            print_line(f"segment: {report.summary}")
        end([report], as_json=as_json)
        return
    run_frame_command(
        ("segment",), workspace, 0, split, executor, workers, as_json=as_json, dry_run=dry_run
    )
