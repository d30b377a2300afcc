"""The held-out folds of X_l with their teachers."""

from collections.abc import Callable, Iterator
from dataclasses import replace

from pipelines.engine.progress import Progress
from pipelines.engine.runner import Report, run_first
from pipelines.round import graph_of
from pipelines.workspace.folds import open_folds
from pipelines.workspace.workspace import Workspace

ReportCallback = Callable[[Report], None]


def trained_folds(
    workspace: Workspace, folds: int, progress: Progress, record: ReportCallback
) -> Iterator[tuple[Workspace, ReportCallback]]:
    """Yield every fold once its teacher is trained, and the callback for reports of its stages.

    Args:
        workspace: the workspace with X_l.
        folds: number of folds.
        progress: see `Progress`.
        record: called with the report of each stage, whose name ends with the number of the fold.

    Raises:
        ConfigError: see `open_folds`.
    """
    for number, fold in enumerate(open_folds(workspace, folds), start=1):

        def done(report: Report, number: int = number) -> None:
            record(replace(report, stage=f"{report.stage} {number}/{folds}"))

        for first in graph_of(fold).first_stages:
            done(run_first(fold, first, progress))
        yield fold, done
