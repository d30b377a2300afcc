"""The reliability diagram of an audit: the share of right labels against the weight, per policy."""

from collections.abc import Sequence

import numpy as np

from curate.evaluation.audit import Audit, Estimate, Figures
from curate.viewing.canvas import Canvas, Colour, text_width
from curate.viewing.legend import STRIP_HEIGHT, TITLE_HEIGHT, draw_title
from curate.viewing.palette import (
    BACKGROUND,
    FAINT_TEXT,
    GRID,
    PANEL,
    TEXT,
    ZERO_WEIGHT,
    weight_colours,
)

_COLUMNS = 4
_MARGIN, _GAP = 20, 14
_PANEL_WIDTH, _PANEL_HEIGHT = 304, 300
_PLOT_HEIGHT, _COUNT_HEIGHT = 158, 42
_FEW_LABELS = 10
_ROW = 28
_DIAGONAL = (160, 168, 180)


def draw_reliability(audit: Audit, title: str) -> np.ndarray:
    """The picture: a panel per policy, then the AUROC of all with their intervals.

    A bar is the share of right labels among those whose weight lies in a tenth of [0, 1]; weights
    that mean what they say reach the diagonal. Below it is how many labels there are.

    Args:
        audit: all categories, distances and point counts together are shown.
        title: written at the top.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    found = list(audit.whole().values())
    cells = len(found) + 1
    columns = min(_COLUMNS, cells)
    rows = -(-cells // columns)
    width = 2 * _MARGIN + columns * _PANEL_WIDTH + (columns - 1) * _GAP
    height = TITLE_HEIGHT + 2 * _MARGIN + rows * _PANEL_HEIGHT + (rows - 1) * _GAP + STRIP_HEIGHT
    canvas = Canvas(width, height, BACKGROUND)
    draw_title(canvas, title, f"{audit.frames} frames, {found[0].labels} labels" if found else "")
    for cell in range(cells):
        left = _MARGIN + (cell % columns) * (_PANEL_WIDTH + _GAP)
        top = TITLE_HEIGHT + _MARGIN + (cell // columns) * (_PANEL_HEIGHT + _GAP)
        canvas.box(left, top, left + _PANEL_WIDTH, top + _PANEL_HEIGHT, PANEL)
        if cell < len(found):
            _draw_policy(canvas, left, top, found[cell])
        else:
            _draw_aurocs(canvas, left, top, found, audit.level)
    _draw_reading_aid(canvas)
    return canvas.finish()


def _draw_policy(canvas: Canvas, left: int, top: int, figures: Figures) -> None:
    canvas.text(left + 14, top + 25, figures.policy, TEXT, 16)
    notes = (
        f"AUROC {_shown(figures.auroc)}   calibration error {_shown(figures.calibration_error)}",
        f"weight on right labels {_shown(figures.weighted_precision)}",
    )
    for line, note in enumerate(notes):
        canvas.text(left + 14, top + 44 + 16 * line, note, FAINT_TEXT, 11)
    frame = (left + 40, top + 74, left + _PANEL_WIDTH - 14, top + 74 + _PLOT_HEIGHT)
    _draw_axes(canvas, frame)
    bins = figures.bins
    colours = weight_colours((bins.edges[:-1] + bins.edges[1:]) / 2).tolist()
    across = frame[0] + bins.edges * (frame[2] - frame[0])
    most = np.log10(1 + max(int(bins.labels.max()), 1))
    for b in np.flatnonzero(bins.labels):
        red, green, blue = colours[b]
        opacity = 0.4 if bins.labels[b] < _FEW_LABELS else 0.9
        box = (across[b] + 1.5, across[b + 1] - 1.5)
        reached = frame[3] - max(bins.precision[b] * _PLOT_HEIGHT, 1.5)
        canvas.box(box[0], reached, box[1], frame[3], (red, green, blue), opacity)
        count = (_COUNT_HEIGHT - 14) * np.log10(1 + bins.labels[b]) / most
        floor = frame[3] + 20 + _COUNT_HEIGHT
        canvas.box(box[0], floor - count, box[1], floor, ZERO_WEIGHT, 0.55)
        number = _count(int(bins.labels[b]))
        middle = (box[0] + box[1] - text_width(number, 9)) / 2
        canvas.text(middle, floor - count - 3, number, FAINT_TEXT, 9)
    diagonal = np.array([[frame[0], frame[3]], [frame[2], frame[1]]], dtype=float)
    canvas.lines(diagonal, _DIAGONAL, 1.0)


def _draw_axes(canvas: Canvas, frame: tuple[int, int, int, int]) -> None:
    """Lines at 0, 0.5 and 1 of both axes, with their numbers."""
    left, top, right, bottom = frame
    for share in (0.0, 0.5, 1.0):
        down = bottom - share * (bottom - top)
        canvas.lines(np.array([[left, down], [right, down]]), GRID, 1.0)
        canvas.text(left - 26, down + 4, f"{share:.1f}", FAINT_TEXT, 10.5)
        place = left + share * (right - left)
        number = f"{share:.1f}"
        canvas.text(place - text_width(number, 10.5) * share, bottom + 14, number, FAINT_TEXT, 10.5)


def _draw_aurocs(
    canvas: Canvas, left: int, top: int, found: Sequence[Figures], level: float
) -> None:
    """A dot with its interval per policy, the best on top."""
    canvas.text(left + 14, top + 25, "AUROC", TEXT, 16)
    note = f"right above wrong labels; bars: {100 * level:.0f} % interval"
    canvas.text(left + 14, top + 44, note, FAINT_TEXT, 11)
    defined = [each for each in found if not np.isnan(each.auroc.value)]
    if not defined:
        canvas.text(left + 14, top + 84, "nothing to tell apart", FAINT_TEXT, 12)
        return
    lowest = min(min(each.auroc.low, each.auroc.value) for each in defined)
    start = min(0.5, np.floor(10 * lowest) / 10)
    edges = (left + 96.0, left + _PANEL_WIDTH - 54.0)
    bottom = top + 70 + _ROW * len(defined)
    for share in (start, 0.5, 1.0) if start < 0.5 else (0.5, 0.75, 1.0):
        place = edges[0] + (share - start) / (1 - start) * (edges[1] - edges[0])
        canvas.lines(np.array([[place, top + 60.0], [place, bottom]]), GRID, 1.0)
        number = f"{share:g}"
        canvas.text(place - text_width(number, 10.5) / 2, bottom + 15, number, FAINT_TEXT, 10.5)
    order = sorted(defined, key=lambda each: -each.auroc.value)
    colours = weight_colours(np.linspace(1, 0.15, len(order))).tolist()
    for row, (each, (red, green, blue)) in enumerate(zip(order, colours, strict=True)):
        level_y = top + 80.0 + _ROW * row
        canvas.text(left + 14, level_y + 4, each.policy, TEXT, 12)
        places = [
            edges[0] + (value - start) / (1 - start) * (edges[1] - edges[0])
            for value in (each.auroc.low, each.auroc.value, each.auroc.high)
        ]
        _draw_interval(canvas, places, level_y, (red, green, blue))
        canvas.text(edges[1] + 12, level_y + 4, f"{each.auroc.value:.3f}", TEXT, 12)


def _draw_interval(canvas: Canvas, places: Sequence[float], level_y: float, colour: Colour) -> None:
    low, value, high = places
    if not np.isnan([low, high]).any():
        canvas.lines(np.array([[low, level_y], [high, level_y]]), colour, 2.0)
        for end in (low, high):
            canvas.lines(np.array([[end, level_y - 4], [end, level_y + 4]]), colour, 1.5)
    canvas.box(value - 3.5, level_y - 3.5, value + 3.5, level_y + 3.5, colour)


def _draw_reading_aid(canvas: Canvas) -> None:
    top = canvas.height - STRIP_HEIGHT
    canvas.box(0, top, canvas.width, canvas.height, PANEL)
    text = (
        "across: weight; bars: share of right labels, on the diagonal where the weight means what "
        "it says; pale: fewer than 10 labels; below: labels, on a log scale"
    )
    canvas.text(14, top + 25, text, FAINT_TEXT, 12)


def _shown(estimate: Estimate) -> str:
    return "-" if np.isnan(estimate.value) else f"{estimate.value:.2f}"


def _count(labels: int) -> str:
    return f"{labels / 1000:.0f}k" if labels >= 10_000 else str(labels)
