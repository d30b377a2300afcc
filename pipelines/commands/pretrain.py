"""curate pretrain: train the first teacher, w_0, on X_l."""

from pipelines.commands.dry_run import print_preview
from pipelines.commands.options import (
    DryRunOption,
    JsonOption,
    ProcessesOption,
    ThreadsOption,
    WorkspaceOption,
    end,
    open_workspace,
)
from pipelines.reports.terminal import print_report


def pretrain(
    processes: ProcessesOption = None,
    threads: ThreadsOption = None,
    workspace: WorkspaceOption = None,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train the first teacher on the labeled frames only.

    Example: curate pretrain
    """
    from curate.errors import ConfigError
    from pipelines.category_names import check_names
    from pipelines.engine.preview import preview_first
    from pipelines.engine.progress import Bar
    from pipelines.engine.runner import run_first
    from pipelines.round import graph_of

    opened = open_workspace(workspace, threads=threads, processes=processes)
    check_names(opened)
    firsts = list(graph_of(opened).first_stages)
    if not firsts:
        raise ConfigError(
            f"detector '{opened.config.detector.name}' needs no pretraining; run `curate predict`"
        )
    for first in firsts:
        first.check(opened)
    if dry_run:
        print_preview((preview_first(opened, first) for first in firsts), as_json=as_json)
        return
    reports = [run_first(opened, first, Bar()) for first in firsts]
    if not as_json:
        print_report(reports[0])
    end(reports, as_json=as_json)
