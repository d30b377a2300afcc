"""How tables, reports and JSON are printed in a terminal."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from math import isfinite
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from pipelines.engine.runner import Report

UNLIMITED = 10_000


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
