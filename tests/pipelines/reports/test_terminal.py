"""Tables in a terminal, where nothing may be truncated, and in a pipe, where nothing may wrap."""

from pathlib import Path

import pytest
from support.terminals import terminal

from pipelines.reports.terminal import print_line, print_table

COLUMNS = ("frame", "k", "category", "weighted precision", "interval", "sum", "message", "path")
ROWS = [
    (
        f"{i:06d}", i, "Pedestrian", 0.12345678, "0.61 - 0.83", 98765.4,
        "no calibration file for this frame", f"training/velodyne/{i:06d}.bin",
    )
    for i in range(3)
]  # fmt: skip
WHOLE = ["0.1235", "98765", "0.61 - 0.83", *(row[0] for row in ROWS), *(row[7] for row in ROWS)]


@pytest.mark.parametrize("width", [30, 60, 80, 100, 120, 200])
def test_no_number_or_identifier_is_truncated(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    """Each is complete in its own line or cell, and the lines fit."""
    with terminal(monkeypatch, width) as screen:
        print_table(COLUMNS, ROWS, title="Labels of three frames with a title that has to wrap too")
    assert max(map(len, screen.lines)) <= width
    assert "…" not in screen.text
    assert [value for value in WHOLE if value not in screen.text.split("\r\n", 1)[1]] in (
        [],
        # 29 columns plus a name do not fit into 30.
        [row[7] for row in ROWS] if width == 30 else [],
    )
    words = " ".join(screen.text.split())
    assert all(name.split()[-1] in words for name in COLUMNS)


def test_a_table_that_fits_has_a_line_per_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """A name, a rule, three rows, and an empty line at the end."""
    with terminal(monkeypatch, 200) as screen:
        print_table(COLUMNS, ROWS)
    assert len(screen.lines) == 6
    assert screen.lines[0].split()[:3] == ["frame", "k", "category"]


def test_text_wraps_before_a_table_becomes_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message and the name of two words wrap; the numbers stay in the first line of the row."""
    with terminal(monkeypatch, 110) as screen:
        print_table(COLUMNS, ROWS)
    assert "row 1" not in screen.text
    [first] = [line for line in screen.lines if "000001.bin" in line]
    assert all(value in first for value in ("000001", "0.1235", "0.61 - 0.83", "98765"))
    assert "no calibration file for this frame" not in first


def test_a_table_that_is_too_wide_becomes_a_block_per_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """Values follow their names; short pairs share lines."""
    columns = [f"column_{i}" for i in range(8)]
    with terminal(monkeypatch, 60) as screen:
        print_table(columns, [[i / 7] * 8 for i in range(2)])
    assert [line.split("─")[0] for line in screen.lines if "row" in line] == ["row 1 ", "row 2 "]
    assert screen.lines[1].split() == ["column_0", "0", "column_1", "0", "column_2", "0"]
    assert sum("column_7  0.1429" in line for line in screen.lines) == 1


def test_a_table_without_rows_shows_its_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if they do not fit side by side."""
    for width in (40, 200):
        with terminal(monkeypatch, width) as screen:
            print_table(COLUMNS, [])
        assert max(map(len, screen.lines)) <= width
        assert all(word in screen.text for name in COLUMNS for word in name.split())


def test_a_table_without_rows_may_have_a_column_without_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with terminal(monkeypatch, 80) as screen:
        print_table(("figure", ""), [])
    assert "figure" in screen.text


def test_wide_characters_count_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on the screen."""
    with terminal(monkeypatch, 30) as screen:
        print_table(("name", "frame"), [("行人" * 5, "000001"), ("自転車", "000002")])
    assert "行人" * 5 in screen.text
    assert "000002" in screen.text


def test_brackets_and_control_characters_are_escaped(monkeypatch: pytest.MonkeyPatch) -> None:
    """A value is text: neither markup nor a control sequence for the terminal."""
    with terminal(monkeypatch, 80) as screen:
        print_table(("value",), [("[red]x[/red] :car: \x1b[2J",)])
    assert "[red]x[/red] :car: \\x1b[2J" in screen.text


@pytest.mark.parametrize("no_color", ["", "1"])
def test_nothing_is_coloured(monkeypatch: pytest.MonkeyPatch, no_color: str) -> None:
    """With NO_COLOR and without."""
    with terminal(monkeypatch, 80) as screen:
        monkeypatch.setenv("NO_COLOR", no_color)
        print_table(COLUMNS, ROWS, title="title")
    assert "\x1b" not in screen.text


def test_a_pipe_gets_whole_rows_of_any_width(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Whatever COLUMNS and FORCE_COLOR are."""
    texts = set()
    for columns in ("20", "80", "500"):
        monkeypatch.setenv("COLUMNS", columns)
        monkeypatch.setenv("FORCE_COLOR", "1")
        print_table(COLUMNS, ROWS, title="title " * 30)
        print_line("word " * 100)
        texts.add(capsys.readouterr().out)
    [text] = texts
    lines = text.splitlines()
    assert len(lines) == 1 + 2 + 3 + 1 + 1
    assert all(value in text for value in WHOLE)
    assert "\x1b" not in text


def test_lines_wrap_with_a_hanging_indent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers are not broken."""
    with terminal(monkeypatch, 60) as screen:
        print_line("  consistency    " + "loss 0.123456 and " * 6, indent=17)
    assert max(map(len, screen.lines)) <= 60
    assert all(line.startswith(" " * 17) for line in screen.lines[1:])
    assert screen.text.count("0.123456") == 6


@pytest.mark.parametrize(("lines", "paged"), [(10, True), (100, False)])
def test_only_a_long_table_uses_a_pager(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, lines: int, *, paged: bool
) -> None:
    """PAGER is used if the table is longer than the terminal."""
    monkeypatch.setenv("PAGER", f"cat > {tmp_path / 'paged'}")
    monkeypatch.delenv("MANPAGER", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    with terminal(monkeypatch, 200, lines) as screen:
        print_table(COLUMNS, ROWS * 5, page=True)
    assert (tmp_path / "paged").exists() == paged
    text = (tmp_path / "paged").read_text() if paged else screen.text
    assert text.count("000001.bin") == 5


def test_a_pipe_uses_no_pager(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setenv("PAGER", f"cat > {tmp_path / 'paged'}")
    print_table(COLUMNS, ROWS * 500, page=True)
    assert not (tmp_path / "paged").exists()
    assert capsys.readouterr().out.count("000001.bin") == 500
