"""The strip below a picture that says what its colours mean."""

import numpy as np

from curate.viewing.canvas import Canvas, Colour, text_width
from curate.viewing.palette import (
    FAINT_TEXT,
    GROUND_TRUTH,
    IGNORED,
    PANEL,
    TEXT,
    weight_colours,
)

STRIP_HEIGHT = 40
TITLE_HEIGHT = 36

_BAR_PIXELS = 150
_GAP = 28.0


def draw_title(canvas: Canvas, title: str, note: str) -> None:
    """The strip above the picture: a title, and a note at the right."""
    canvas.box(0, 0, canvas.width, TITLE_HEIGHT, PANEL)
    canvas.text(14, 24, title, TEXT, 16)
    canvas.text(canvas.width - 14 - text_width(note, 12), 23, note, FAINT_TEXT, 12)


def draw_legend(canvas: Canvas, *, truth: bool) -> None:
    """The strip at the bottom: weight scale, ignored labels and, if `truth`, ground truth."""
    top = canvas.height - STRIP_HEIGHT
    canvas.box(0, top, canvas.width, canvas.height, PANEL)
    baseline = top + 25.0
    left = _weight_bar(canvas, 14.0, top + 13.0, baseline)
    left = _swatch(canvas, left, baseline, "weight 0: ignored", IGNORED)
    if truth:
        _swatch(canvas, left, baseline, "ground truth", GROUND_TRUTH)


def _weight_bar(canvas: Canvas, left: float, top: float, baseline: float) -> float:
    """The colour bar from 0 to 1; returns where the next entry may start."""
    canvas.text(left, baseline, "weight", TEXT)
    left += text_width("weight") + 10
    canvas.text(left, baseline, "0", FAINT_TEXT)
    left += text_width("0") + 6
    colours = weight_colours(np.linspace(1e-6, 1, _BAR_PIXELS))
    for offset, (red, green, blue) in enumerate(colours.tolist()):
        canvas.box(left + offset, top, left + offset + 1, top + 14, (red, green, blue))
    left += _BAR_PIXELS + 6
    canvas.text(left, baseline, "1", FAINT_TEXT)
    return left + text_width("1") + _GAP


def _swatch(canvas: Canvas, left: float, baseline: float, name: str, colour: Colour) -> float:
    corners = np.array([[0, -10], [20, -10], [20, 1], [0, 1]])
    canvas.lines(corners + np.array([left, baseline]), colour, 1.5, closed=True)
    canvas.text(left + 28, baseline, name, TEXT)
    return left + 28 + text_width(name) + _GAP
