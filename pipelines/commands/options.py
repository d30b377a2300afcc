"""Options that several commands share."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

if TYPE_CHECKING:
    from pipelines.engine.runner import Report
    from pipelines.workspace.workspace import Workspace

WorkspaceOption = Annotated[
    Optional[Path],  # noqa: UP045 - typer reads this form on every Python
    typer.Option("--workspace", "-w", help="Folder; default: the current one or one above it."),
]
RoundOption = Annotated[
    Optional[int],  # noqa: UP045
    typer.Option("--round", min=1, help="Round; default: the first without a student."),
]
PolicyOption = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option("--policy", help="Policy; default: run.method of curate.toml."),
]
ExecutorOption = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option(
        "--executor", help="serial, process or ray; default: run.executor of curate.toml."
    ),
]
WorkersOption = Annotated[
    Optional[int],  # noqa: UP045
    typer.Option(
        "--workers",
        min=1,
        help="Workers, each with its own model; more than one need process or ray.",
    ),
]
ThreadsOption = Annotated[
    Optional[int],  # noqa: UP045
    typer.Option("--threads", min=1, help="Threads; default: train.threads of curate.toml."),
]
ChartFormatOption = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option("--format", help="Format of chart files: svg, png or pdf."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")]


def open_workspace(
    folder: Path | None,
    executor: str | None = None,
    workers: int | None = None,
    threads: int | None = None,
) -> "Workspace":
    """The workspace, with what the command line changes for this run."""
    from pipelines.workspace.workspace import Workspace

    workspace = Workspace.open(folder)
    changes: dict[str, Any] = {}
    if workers is not None:
        changes["workers"] = workers
        if workspace.config.run.executor in {"serial", "process"}:
            changes["executor"] = "process" if workers > 1 else "serial"
    if executor is not None:
        changes["executor"] = executor
    workspace = workspace.with_settings("run", **changes)
    return workspace.with_settings("train", **({"threads": threads} if threads else {}))


def end(reports: Sequence["Report"], *, as_json: bool) -> None:
    """Ends a command that ran stages.

    Raises:
        FramesFailed: some frames failed.
    """
    from curate.errors import FramesFailed
    from pipelines.reports.terminal import print_json

    if as_json:
        print_json(list(reports))
    failed = sum(report.failed for report in reports)
    if failed:
        raise FramesFailed(
            f"{failed} frame results failed and are recorded; see `curate status --failed`, "
            "mend the files and run the command again"
        )
