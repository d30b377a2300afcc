"""Print tables, lines, reports and JSON, to a terminal or a pipe.

In a terminal, lines are at most as long as the terminal is wide, and numbers and identifiers are
never split: text wraps at spaces, and a table that is still too wide is printed as one block per
row. In a pipe or a file, each row is one line of any length. The output has no colours.
"""

import json
import os
import shutil
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from math import isfinite, isnan
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from rich.console import RenderableType

    from pipelines.engine.runner import Report

NARROWEST = 20
"""The smallest width of a terminal; a smaller reported width is ignored."""
_TEXT_WIDTH = 16  # smallest width of a column with wrapped text
_PAIR_GAP = 3  # gap between two name-value pairs of a block

Cells = Sequence[Sequence[str]]


def print_json(value: Any) -> None:
    """Print a value, a dataclass or a list of them as JSON; NaN and infinity are null."""
    typer.echo(json.dumps(_plain(value), indent=1, default=str, allow_nan=False))


def print_json_rows(rows: Iterable[Any]) -> None:
    """Print values as a JSON list like `print_json`, each as soon as it is available."""
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
    """Print rows as a table with right-aligned numbers, followed by an empty line.

    Args:
        columns: names of the columns.
        rows: rows with a value per column; floats are rounded to four digits.
        title: text above the table.
        page: whether to use a pager for a table that is longer than the terminal.
    """
    print_tables([(title, columns, rows)], page=page)


def print_tables(
    tables: Iterable[tuple[str, Sequence[str], Iterable[Sequence[Any]]]], *, page: bool = False
) -> None:
    """Print several tables like `print_table`, with a single pager.

    Args:
        tables: title, columns and rows of each table.
        page: see `print_table`.
    """
    parts = []
    for title, columns, rows in tables:
        cells = [[_cell(value) for value in row] for row in rows]
        heading = f"{_wrapped(title)}\n" if title else ""
        parts.append(heading + _laid_out(columns, cells, terminal_width()) + "\n")
    _write("\n".join(parts), page=page)


def print_line(text: str, indent: int = 0) -> None:
    """Print text; in a terminal it wraps at spaces.

    Args:
        text: one or more lines.
        indent: number of spaces at the start of continuation lines.
    """
    typer.echo(_wrapped(text, indent))


def terminal_width() -> int | None:
    """Return the width of the terminal; None if standard output is a pipe or a file."""
    if not sys.stdout.isatty():
        return None
    return max(_terminal_size().columns, NARROWEST)


def _terminal_size() -> os.terminal_size:
    """Return COLUMNS and LINES if they are set, else the size of the terminal, else 80 x 24."""
    try:
        reported = os.get_terminal_size(sys.stdout.fileno())
    except (OSError, ValueError):
        reported = os.terminal_size((0, 0))
    return shutil.get_terminal_size((reported.columns or 80, reported.lines or 24))


def _write(text: str, *, page: bool) -> None:
    """Print text, with a pager if it is requested, useful, and input and output are a terminal."""
    size = _terminal_size()
    if page and sys.stdin.isatty() and sys.stdout.isatty() and text.count("\n") >= size.lines:
        import pydoc

        os.environ.setdefault("LESS", "FRX")  # X keeps the text on the screen
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
    """Return a table, or blocks if a table would be wider than `width`."""
    for gap in (2, 1):
        room = None if width is None else width - gap * (len(columns) - 1)
        widths = _column_widths(columns, cells, room)
        if widths is not None:
            return _as_table(columns, cells, widths, gap)
    if not cells:
        return _wrapped(f"no rows of {', '.join(columns)}") + "\n"
    return _as_blocks(columns, cells, width or NARROWEST)


def _column_widths(columns: Sequence[str], cells: Cells, room: int | None) -> list[int] | None:
    """Return the width of each column, in total at most `room`; None if they do not fit.

    Each column gets at least the width of its longest number or word. The remaining width goes to
    the narrowest columns first, so that only long text wraps.
    """
    from rich.cells import cell_len

    by_column = [[row[i] for row in cells] for i in range(len(columns))]
    natural, least = [], []
    for name, values in zip(columns, by_column, strict=True):
        lines = [line for value in (name, *values) for line in value.splitlines() or [""]]
        natural.append(max(map(cell_len, lines)))
        parts = (part for text in (*name.split(), *values) for part in _parts(text))
        unbroken = max(map(cell_len, parts), default=0)
        text = any(_is_text(value) for value in values)
        least.append(max(unbroken, min(natural[-1], _TEXT_WIDTH)) if text else unbroken)
    if room is None or sum(natural) <= room:
        return natural
    for most in range(room, 0, -1):
        widths = [max(low, min(high, most)) for low, high in zip(least, natural, strict=True)]
        if sum(widths) <= room:
            return widths
    return None


def _parts(value: str) -> Sequence[str]:
    """Return the unbreakable parts of a value: the words of a text, else its whole lines."""
    return value.split() if _is_text(value) else value.splitlines() or [""]


def _is_text(value: str) -> bool:
    """Return whether a value may be wrapped at spaces; "0.1 - 0.2" may not."""
    return " " in value and any(map(str.isalpha, value))


def _as_table(columns: Sequence[str], cells: Cells, widths: Sequence[int], gap: int) -> str:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    # The box style already puts one space between two columns.
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, gap - 1, 0, 0))
    for i, (name, width) in enumerate(zip(columns, widths, strict=True)):
        numeric = bool(cells) and all(_is_number(row[i]) for row in cells)
        table.add_column(Text(name), width=width, justify="right" if numeric else "left")
    for row in cells:
        table.add_row(*map(Text, row))
    return _rendered(table, sum(widths) + gap * (len(widths) - 1))


def _as_blocks(columns: Sequence[str], cells: Cells, width: int) -> str:
    """Return one block per row, with as many name-value pairs per line as fit."""
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
    """Return the number of pairs per line, and the widths of name and value of each.

    Lines are filled from left to right: pair i is in column i modulo the number. With one pair per
    line, the width may be smaller than a value, which then wraps.
    """
    for count in range(len(names), 1, -1):
        widths = [(max(names[j::count]), max(values[j::count])) for j in range(count)]
        if sum(name + 2 + value for name, value in widths) + _PAIR_GAP * (count - 1) <= width:
            return count, widths
    name = min(max(names), width // 2)
    return 1, [(name, width - name - 2)]


def _rendered(renderable: "RenderableType", width: int) -> str:
    """Return plain text without trailing spaces."""
    from rich.console import Console

    console = Console(color_system=None, width=width)
    with console.capture() as captured:
        console.print(renderable)
    return "".join(f"{line.rstrip()}\n" for line in captured.get().splitlines())


def print_missing(frames: Sequence[str]) -> None:
    """Print one line about the failed frames that are not in an export; nothing without any."""
    from curate.exporters.base import named

    if frames:
        print_line(
            f"failed frames that are missing from the export: {len(frames)} ({named(frames)}); "
            "see `curate status --failed`",
            indent=4,
        )


def print_report(report: "Report") -> None:
    """Print one line about a stage, and the first errors of its failed frames."""
    line = f"round {report.round}  {report.stage:<11} "
    if report.summary:
        line += report.summary
    else:
        line += f"{report.done} frames done"
        line += f", {report.labels} rows" if report.round else ""  # work of no round has no rows
        states: Mapping[str, int] = {"empty": report.empty, "failed": report.failed}
        line += "".join(f", {n} {state}" for state, n in states.items() if n)
        line += f", {report.kept} already done" if report.kept else ""
    print_line(f"{line}  ({report.seconds:.1f} s)", indent=4)
    print_missing(report.missing)
    for frame, error in report.errors[:5]:
        typer.echo(f"  failed {frame}: {error}", err=True)
    if len(report.errors) > 5:
        typer.echo("  ... for all errors: curate status --failed", err=True)


def _cell(value: Any) -> str:
    """Return a value as text, with control characters escaped; "-" for NaN."""
    if value is None:
        return ""
    if isinstance(value, float):
        if isnan(value):
            return "-"
        return f"{value:.0f}" if 1e4 <= abs(value) < 1e15 else f"{value:.4g}"
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in str(value))


def _is_number(text: str) -> bool:
    """Return whether a value is a number or "-", to be right-aligned; 000012 is a frame id."""
    if text == "-":
        return True
    if text[:1] == "0" and text[1:2].isdigit():
        return False
    try:
        float(text or "0")
    except ValueError:
        return False
    return True
