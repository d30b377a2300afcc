"""Render a self-contained HTML page: style, charts and images are inside the file."""

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from curate.viewing.canvas import jpeg
from curate.viewing.chart_style import Chart

_STYLE = """
:root { color-scheme: light dark; --ground: #fff; --text: #1b2129; --faint: #5b6675;
  --line: #d5dae2; --panel: #f4f6f9; --bar: #2a7fb8; --mark: #c2410c; }
@media (prefers-color-scheme: dark) { :root { --ground: #0d1015; --text: #e2e7ee; --faint: #94a0b0;
  --line: #2c333e; --panel: #161a21; --bar: #4fb0d8; --mark: #f59e5b; } }
body { margin: 0 auto; max-width: 1080px; padding: 24px; background: var(--ground);
  color: var(--text); font: 15px/1.5 system-ui, sans-serif; }
h1 { font-size: 24px; margin: 0; } h2 { font-size: 18px; margin: 32px 0 8px; }
p { margin: 4px 0 12px; color: var(--faint); }
.row { display: grid; grid-template-columns: repeat(auto-fit, minmax(320px, 1fr)); gap: 16px; }
figure { margin: 0; padding: 12px; background: var(--panel); border-radius: 6px; min-width: 0; }
figcaption { font-size: 13px; margin-top: 6px; color: var(--faint); overflow-wrap: anywhere; }
figure img, svg { display: block; width: 100%; height: auto; border-radius: 4px; }
.scroll { overflow-x: auto; } .scroll + .row { margin-top: 16px; }
table { border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums; }
th, td { padding: 3px 12px 3px 0; border-bottom: 1px solid var(--line); text-align: right; }
th { color: var(--faint); font-weight: 500; }
th:first-child, td.text { text-align: left; } tr.all td { font-weight: 600; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(170px, 1fr)); gap: 12px;
  margin: 12px 0; }
.facts div { padding: 8px 12px; background: var(--panel); border-radius: 6px; min-width: 0; }
.facts dt { font-size: 13px; color: var(--faint); }
.facts dd { margin: 0; font-size: 20px; overflow-wrap: anywhere; }
"""


ALL = "all"
"""The text of the first or second cell in a row of totals."""


@dataclass(frozen=True)
class Figure:
    """A chart or an image with its caption.

    Attributes:
        content: an <svg> or <img> element, which is not escaped.
        caption: plain text.
        chart: the chart, which can also be saved as a file; None for an image.
    """

    content: str
    caption: str
    chart: Chart | None = None

    @classmethod
    def of_chart(cls, chart: Chart, caption: str) -> "Figure":
        """Return a figure with an inline chart."""
        return cls(chart.inline(), caption, chart)

    @classmethod
    def of_image(cls, rgb: np.ndarray, caption: str) -> "Figure":
        """Return a figure with an embedded (h, w, 3) uint8 RGB image."""
        data = base64.b64encode(jpeg(rgb)).decode("ascii")
        image = f'<img alt="{escape(caption)}" src="data:image/jpeg;base64,{data}">'
        return cls(image, caption)


@dataclass(frozen=True)
class Section:
    """A section of the page; all texts are plain and are escaped.

    Attributes:
        title: heading of the section.
        note: text below the heading, "" for none.
        facts: names and values, shown as tiles.
        columns: column names of the table; empty for no table.
        rows: rows of the table; floats are shown with four digits, None as an empty cell. A row
            with ALL in the first or second cell is highlighted as a total.
        figures: figures, shown side by side.
    """

    title: str
    note: str = ""
    columns: Sequence[str] = ()
    rows: Sequence[Sequence[Any]] = ()
    figures: Sequence[Figure] = ()
    facts: Sequence[tuple[str, str]] = ()


def render_page(title: str, note: str, sections: Iterable[Section]) -> str:
    """Return the HTML text; it loads no external resources."""
    body = "\n".join(_section(each) for each in sections)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head>\n"
        f"<body><h1>{escape(title)}</h1><p>{escape(note)}</p>\n{body}\n</body></html>\n"
    )


def _section(section: Section) -> str:
    parts = [f"<section><h2>{escape(section.title)}</h2>"]
    if section.note:
        parts.append(f"<p>{escape(section.note)}</p>")
    if section.facts:
        tiles = "".join(
            f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>"
            for name, value in section.facts
        )
        parts.append(f'<dl class="facts">{tiles}</dl>')
    if section.columns:
        heads = "".join(f"<th>{escape(name)}</th>" for name in section.columns)
        lines = "\n".join(_row(row) for row in section.rows)
        parts.append(
            f'<div class="scroll"><table><thead><tr>{heads}</tr></thead>'
            f"<tbody>{lines}</tbody></table></div>"
        )
    if section.figures:
        shown = "\n".join(
            f"<figure>{each.content}<figcaption>{escape(each.caption)}</figcaption></figure>"
            for each in section.figures
        )
        parts.append(f'<div class="row">{shown}</div>')
    return "\n".join([*parts, "</section>"])


def _row(row: Sequence[Any]) -> str:
    opening = '<tr class="all">' if ALL in row[:2] else "<tr>"
    cells = (
        f'<td class="text">{escape(value)}</td>'
        if isinstance(value, str)
        else f"<td>{escape(_cell(value))}</td>"
        for value in row
    )
    return f"{opening}{''.join(cells)}</tr>"


def _cell(value: Any) -> str:
    if value is None or value != value:  # noqa: PLR0124 - NaN is not equal to itself
        return ""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else str(value)
