"""Options that several commands share, and how commands print."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from math import isfinite
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
UNLIMITED = 10_000
ThreadsOption = Annotated[
    Optional[int],  # noqa: UP045
    typer.Option("--threads", min=1, help="Threads; default: train.threads of curate.toml."),
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


def print_json(value: Any) -> None:
    """Prints a value, a dataclass or a list of them as JSON; NaN and infinity as null."""
    typer.echo(json.dumps(_plain(value), indent=1, default=str, allow_nan=False))


def print_json_rows(rows: Iterable[Any]) -> None:
    """Prints values as the list that `print_json` would print, each as it comes."""
    before = "["
    for row in rows:
        text = json.dumps(_plain(row), indent=1, default=str, allow_nan=False)
        typer.echo(before + "\n " + text.replace("\n", "\n "), nl=False)
        before = ","
    typer.echo("[]" if before == "[" else "\n]")


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def print_table(
    columns: Sequence[str],
    rows: Iterable[Sequence[Any]],
    title: str = "",
    *,
    dense: bool = False,
) -> None:
    """Prints rows as a table, dense where many columns share a line; numbers to the right."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table(
        title=title or None,
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 0 if dense else 1),
    )
    cells = [[_cell(value) for value in row] for row in rows]
    numeric = [
        all(_is_number(row[i]) for row in cells) and bool(cells) for i in range(len(columns))
    ]
    for name, right in zip(columns, numeric, strict=True):
        table.add_column(name, justify="right" if right else "left", no_wrap=True)
    for row in cells:
        table.add_row(*row)
    console = Console()
    # In a file or a pipe nothing is cut off.
    console.width = console.width if console.is_terminal else UNLIMITED
    console.print(table, soft_wrap=not console.is_terminal)


def print_report(report: "Report") -> None:
    """One line on what a stage did, and the first errors of its failed frames."""
    line = f"round {report.round}  {report.stage:<11} "
    if report.summary:
        line += report.summary
    else:
        line += f"{report.done} frames done, {report.labels} rows"
        states: Mapping[str, int] = {"empty": report.empty, "failed": report.failed}
        line += "".join(f", {n} {state}" for state, n in states.items() if n)
        line += f", {report.kept} already done" if report.kept else ""
    typer.echo(f"{line}  ({report.seconds:.1f} s)")
    for frame, error in report.errors[:5]:
        typer.echo(f"  failed {frame}: {error}", err=True)
    if len(report.errors) > 5:
        typer.echo("  ... all of them: curate status --failed", err=True)


def end(reports: Sequence["Report"], *, as_json: bool) -> None:
    """Ends a command that ran stages.

    Raises:
        FramesFailed: some frames failed.
    """
    from curate.errors import FramesFailed

    if as_json:
        print_json(list(reports))
    failed = sum(report.failed for report in reports)
    if failed:
        raise FramesFailed(
            f"{failed} frame results failed and are recorded; see `curate status --failed`, "
            "mend the files and run the command again"
        )


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _is_number(text: str) -> bool:
    try:
        float(text or "0")
    except ValueError:
        return False
    return True
