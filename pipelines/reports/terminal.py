"""How tables, lines, reports and JSON are printed, in a terminal and in a pipe.

In a terminal no line is longer than the terminal is wide, and no number or identifier is cut: text
wraps at spaces, and a table that is still too wide becomes one block per row. In a pipe or a file
each row is one line, however long. Nothing is coloured.
"""

import json
import os
import shutil
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from math import isfinite
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from rich.console import RenderableType

    from pipelines.engine.runner import Report

NARROWEST = 20
"""A terminal that reports fewer columns than this is treated as this wide."""
_TEXT_WIDTH = 16  # text is not wrapped to a narrower column than this
_PAIR_GAP = 3  # columns between two name-value pairs of a block

Cells = Sequence[Sequence[str]]


def print_json(value: Any) -> None:
    """Print a value, a dataclass or a list of them as JSON; NaN and infinity as null."""
    typer.echo(json.dumps(_plain(value), indent=1, default=str, allow_nan=False))


def print_json_rows(rows: Iterable[Any]) -> None:
    """Print values as the list that `print_json` would print, each as it comes."""
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
    columns: Sequence[str], rows: Iterable[Sequence[Any]], title: str = "", *, page: bool = False
) -> None:
    """Print rows as a table with numbers to the right, and an empty line behind it.

    Args:
        columns: their names.
        rows: a value per column; fractions are rounded to four digits.
        title: printed above the table.
        page: whether a table that is longer than the terminal goes through a pager.
    """
    print_tables([(title, columns, rows)], page=page)


def print_tables(
    tables: Iterable[tuple[str, Sequence[str], Iterable[Sequence[Any]]]], *, page: bool = False
) -> None:
    """Print several tables as `print_table` does, in one run of the pager.

    Args:
        tables: title, columns and rows of each.
        page: see `print_table`.
    """
    parts = []
    for title, columns, rows in tables:
        cells = [[_cell(value) for value in row] for row in rows]
        heading = f"{_wrapped(title)}\n" if title else ""
        parts.append(heading + _laid_out(columns, cells, terminal_width()) + "\n")
    _write("\n".join(parts), page=page)


def print_line(text: str, indent: int = 0) -> None:
    """Print text that wraps at spaces in a terminal.

    Args:
        text: one or more lines.
        indent: spaces before what is continued on a further line.
    """
    typer.echo(_wrapped(text, indent))


def terminal_width() -> int | None:
    """Return the columns of the terminal that standard output is; None for a pipe or file."""
    if not sys.stdout.isatty():
        return None
    return max(_terminal_size().columns, NARROWEST)


def _terminal_size() -> os.terminal_size:
    """Return COLUMNS and LINES where they are set, else what the terminal reports, else 80 x 24."""
    try:
        reported = os.get_terminal_size(sys.stdout.fileno())
    except (OSError, ValueError):
        reported = os.terminal_size((0, 0))
    return shutil.get_terminal_size((reported.columns or 80, reported.lines or 24))


def _write(text: str, *, page: bool) -> None:
    """Print text, through the pager where it is asked for and both ends are a terminal."""
    size = _terminal_size()
    if page and sys.stdin.isatty() and sys.stdout.isatty() and text.count("\n") >= size.lines:
        import pydoc

        os.environ.setdefault("LESS", "FRX")  # leaves the text on the screen
        pydoc.pager(text)
    else:
        typer.echo(text, nl=False)


def _wrapped(text: str, indent: int = 0) -> str:
    width = terminal_width()
    if width is None:
        return text
    hanging = " " * (indent if indent <= width // 2 else 4)
    return "\n".join(
        textwrap.fill(line, width, subsequent_indent=hanging, break_on_hyphens=False)
        for line in text.splitlines()
    )


def _laid_out(columns: Sequence[str], cells: Cells, width: int | None) -> str:
    """Return a table, or blocks where a table would be wider than `width`."""
    for gap in (2, 1):
        room = None if width is None else width - gap * (len(columns) - 1)
        widths = _column_widths(columns, cells, room)
        if widths is not None:
            return _as_table(columns, cells, widths, gap)
    if not cells:
        return _wrapped(f"no rows of {', '.join(columns)}") + "\n"
    return _as_blocks(columns, cells, width or NARROWEST)


def _column_widths(columns: Sequence[str], cells: Cells, room: int | None) -> list[int] | None:
    """Return the width of each column, together at most `room`; None where they do not fit.

    Each column gets at least what its numbers and words need. The rest goes to the narrowest
    columns first, so that only long text wraps.
    """
    from rich.cells import cell_len

    by_column = [[row[i] for row in cells] for i in range(len(columns))]
    wanted, least = [], []
    for name, values in zip(columns, by_column, strict=True):
        lines = [line for value in (name, *values) for line in value.splitlines() or [""]]
        wanted.append(max(map(cell_len, lines)))
        unbroken = max(cell_len(part) for text in (*name.split(), *values) for part in _parts(text))
        text = any(_is_text(value) for value in values)
        least.append(max(unbroken, min(wanted[-1], _TEXT_WIDTH)) if text else unbroken)
    if room is None or sum(wanted) <= room:
        return wanted
    for most in range(room, 0, -1):
        widths = [max(low, min(high, most)) for low, high in zip(least, wanted, strict=True)]
        if sum(widths) <= room:
            return widths
    return None


def _parts(value: str) -> Sequence[str]:
    """Return what must not be broken in a value: words of text, the whole of anything else."""
    return value.split() if _is_text(value) else value.splitlines() or [""]


def _is_text(value: str) -> bool:
    """Return whether a value may be wrapped at its spaces, unlike 0.1 - 0.2."""
    return " " in value and any(map(str.isalpha, value))


def _as_table(columns: Sequence[str], cells: Cells, widths: Sequence[int], gap: int) -> str:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    # The box itself leaves one column between two columns of the table.
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, gap - 1, 0, 0))
    for i, (name, width) in enumerate(zip(columns, widths, strict=True)):
        numeric = bool(cells) and all(_is_number(row[i]) for row in cells)
        table.add_column(Text(name), width=width, justify="right" if numeric else "left")
    for row in cells:
        table.add_row(*map(Text, row))
    return _rendered(table, sum(widths) + gap * (len(widths) - 1))


def _as_blocks(columns: Sequence[str], cells: Cells, width: int) -> str:
    """Return a block per row: as many pairs of name and value side by side as fit."""
    from rich.cells import cell_len
    from rich.rule import Rule
    from rich.table import Table
    from rich.text import Text

    names = [cell_len(name) for name in columns]
    values = [max(cell_len(row[i]) for row in cells) for i in range(len(columns))]
    count, widths = _pairs_per_line(names, values, width)
    blocks = []
    for number, row in enumerate(cells, start=1):
        grid = Table.grid(padding=(0, 2, 0, 0))
        for j, (name, value) in enumerate(widths):
            last = j == len(widths) - 1
            grid.add_column(width=name, overflow="fold")
            grid.add_column(width=value + (0 if last else _PAIR_GAP - 2), overflow="fold")
        for start in range(0, len(columns), count):
            line = zip(columns[start : start + count], row[start : start + count], strict=True)
            grid.add_row(*(Text(part) for pair in line for part in pair))
        heading = Rule(f"row {number}", align="left")
        blocks.append(_rendered(heading, width) + _rendered(grid, width))
    return "".join(blocks)


def _pairs_per_line(
    names: Sequence[int], values: Sequence[int], width: int
) -> tuple[int, list[tuple[int, int]]]:
    """Return how many pairs stand side by side, and the widths of name and value of each.

    The pairs fill the lines from left to right, so that pair i stands at place i modulo the count.
    A single pair to a line may be narrower than its value, which then wraps.
    """
    for count in range(len(names), 1, -1):
        widths = [(max(names[j::count]), max(values[j::count])) for j in range(count)]
        if sum(name + 2 + value for name, value in widths) + _PAIR_GAP * (count - 1) <= width:
            return count, widths
    name = min(max(names), width // 2)
    return 1, [(name, width - name - 2)]


def _rendered(what: "RenderableType", width: int) -> str:
    """Return plain text, without spaces at the ends of lines."""
    from rich.console import Console

    console = Console(color_system=None, width=width)
    with console.capture() as captured:
        console.print(what)
    return "".join(f"{line.rstrip()}\n" for line in captured.get().splitlines())


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
    print_line(f"{line}  ({report.seconds:.1f} s)", indent=4)
    for frame, error in report.errors[:5]:
        typer.echo(f"  failed {frame}: {error}", err=True)
    if len(report.errors) > 5:
        typer.echo("  ... all of them: curate status --failed", err=True)


def _cell(value: Any) -> str:
    """Return a value as text; what would steer the terminal is spelled out."""
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.0f}" if 1e4 <= abs(value) < 1e15 else f"{value:.4g}"
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in str(value))


def _is_number(text: str) -> bool:
    """Return whether a value is right-aligned; 000012 is a frame id."""
    if text[:1] == "0" and text[1:2].isdigit():
        return False
    try:
        float(text or "0")
    except ValueError:
        return False
    return True
