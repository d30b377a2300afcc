"""Options that several commands share."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from pipelines.registry import EXECUTORS, POLICIES, Registry
from pipelines.workspace.splits import SPLITS

if TYPE_CHECKING:
    from pipelines.engine.runner import Report
    from pipelines.workspace.workspace import Workspace


def one_of(names: Iterable[str]) -> str:
    """Return names as in help texts: "a, b or c"."""
    *others, last = names
    return f"{', '.join(others)} or {last}" if others else last


def registered(registry: Registry, *others: str) -> str:
    """Return the valid names of an extension, with `module:Class` for user-supplied classes."""
    return one_of((*registry.classes, *others, "module:Class"))


def complete(names: Iterable[str]) -> Callable[[str], list[str]]:
    """Return a function that completes a half-typed name in the shell."""
    choices = list(names)
    return lambda incomplete: [name for name in choices if name.startswith(incomplete)]


WorkspaceOption = Annotated[
    Optional[Path],  # noqa: UP045 - typer reads this form on every Python
    typer.Option(
        "--workspace",
        "-w",
        help="Folder of the workspace; default: the current folder or the nearest one above it.",
    ),
]
RoundOption = Annotated[
    Optional[int],  # noqa: UP045
    typer.Option(
        "--round", min=1, help="Number of the round; default: the first without a student."
    ),
]
PolicyOption = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option(
        "--policy",
        help="Policy of the weights, see `curate solve -h`; default: run.method of curate.toml.",
        autocompletion=complete(POLICIES.classes),
    ),
]
LastRoundOption = Annotated[
    Optional[int],  # noqa: UP045
    typer.Option(
        "--round", min=1, help="Number of the round; default: the last that the policy weighted."
    ),
]
SplitOption = Annotated[
    str,
    typer.Option(
        "--split", help=f"Frames to process: {one_of(SPLITS)}.", autocompletion=complete(SPLITS)
    ),
]
ExecutorOption = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option(
        "--executor",
        help=f"How frames are processed: {registered(EXECUTORS)}; default: run.executor of "
        "curate.toml.",
        autocompletion=complete(EXECUTORS.classes),
    ),
]


def _worker_count(text: str) -> int | str:
    """Return the number in a `--workers` option, or "auto"."""
    if text != "auto" and not (text.isdecimal() and int(text) > 0):
        raise typer.BadParameter(f"{text!r} is not a whole number from 1 up, and not auto")
    return text if text == "auto" else int(text)


WorkersOption = Annotated[
    Optional[Any],  # noqa: UP045
    typer.Option(
        "--workers",
        parser=_worker_count,
        metavar="N|auto",
        help="Number of workers, each with its own copy of the model; auto is one per core where "
        "that saves time. Default: run.workers of curate.toml.",
    ),
]
ProcessesOption = Annotated[
    Optional[Any],  # noqa: UP045
    typer.Option(
        "--processes",
        parser=_worker_count,
        metavar="N|auto",
        help="Processes that split each step of a training; auto is one per core or GPU. Default: "
        "train.processes of curate.toml.",
    ),
]
ThreadsOption = Annotated[
    Optional[int],  # noqa: UP045
    typer.Option(
        "--threads",
        min=1,
        help="Threads of each process of a training; default: train.threads of curate.toml.",
    ),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON document instead of text.")
]
DryRunOption = Annotated[
    bool,
    typer.Option(
        "--dry-run",
        help="Print what would run, why, and how long it would take; do not run it.",
    ),
]
AllowEmptyOption = Annotated[
    bool,
    typer.Option(
        "--allow-empty",
        help="Write or train on labels even if all of them, or all of a category, are gone.",
    ),
]
ChartFormatOption = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option("--format", help="Format of chart files: svg, png or pdf."),
]


def open_workspace(
    folder: Path | None,
    executor: str | None = None,
    workers: int | str | None = None,
    threads: int | None = None,
    processes: int | str | None = None,
    *,
    allow_empty: bool = False,
) -> "Workspace":
    """Return the workspace with the settings that the command line changes for this run."""
    from pipelines.workspace.workspace import Workspace

    workspace = replace(Workspace.open(folder), allow_empty=allow_empty)
    changes: dict[str, Any] = {}
    if workers is not None:
        changes["workers"] = workers
        if workspace.config.run.executor in {"auto", "serial", "process"}:
            changes["executor"] = {"auto": "auto", 1: "serial"}.get(workers, "process")
    if executor is not None:
        changes["executor"] = executor
    workspace = workspace.with_settings("run", **changes)
    given = {"threads": threads, "processes": processes}
    changes = {name: value for name, value in given.items() if value is not None}
    return workspace.with_settings("train", **changes)


def end(reports: Sequence["Report"], *, as_json: bool) -> None:
    """Print the JSON output of a command that ran stages, and fail if frames failed.

    Raises:
        FramesFailed: if frames failed.
    """
    from curate.errors import FramesFailed
    from pipelines.reports.terminal import print_json

    if as_json:
        print_json(list(reports))
    failed = sum(report.failed for report in reports)
    if failed:
        raise FramesFailed(
            f"{failed} frame results failed and are recorded; see `curate status --failed`, "
            "fix the files and rerun"
        )
