"""The strip below a picture that says what its colours mean."""

import numpy as np

from curate.viewing.canvas import Canvas, Colour, text_width
from curate.viewing.palette import (
    FAINT_TEXT,
    GROUND_TRUTH,
    HUMAN,
    PANEL,
    TEXT,
    UNWEIGHTED,
    ZERO_WEIGHT,
    weight_colours,
)

STRIP_HEIGHT = 40
TITLE_HEIGHT = 36

# Lengths of a dash and a gap in pixels: line styles tell apart whose box it is.
REPREDICTION_DASHES = (6.0, 4.0)
TRUTH_DOTS = (1.5, 3.0)
HUMAN_DASHES = (12.0, 3.0)

_BAR_PIXELS = 150
_GAP = 28.0


def draw_title(canvas: Canvas, title: str, note: str) -> None:
    """The strip above the picture: a title, and a note at the right."""
    canvas.box(0, 0, canvas.width, TITLE_HEIGHT, PANEL)
    canvas.text(14, 24, title, TEXT, 16)
    canvas.text(canvas.width - 14 - text_width(note, 12), 23, note, FAINT_TEXT, 12)


def draw_legend(
    canvas: Canvas,
    *,
    truth: bool,
    repredictions: bool = False,
    unweighted: bool = False,
    human: bool = False,
) -> None:
    """The strip at the bottom: the weight scale, and the line styles and colours that occur."""
    top = canvas.height - STRIP_HEIGHT
    canvas.box(0, top, canvas.width, canvas.height, PANEL)
    baseline = top + 25.0
    left = _weight_bar(canvas, 14.0, top + 13.0, baseline)
    left = _swatch(canvas, left, baseline, "weight 0", ZERO_WEIGHT)
    if unweighted:
        left = _swatch(canvas, left, baseline, "not weighted", UNWEIGHTED)
    if repredictions:
        left = _swatch(canvas, left, baseline, "prediction", TEXT)
        left = _swatch(canvas, left, baseline, "reprediction", TEXT, REPREDICTION_DASHES)
    if human:
        left = _swatch(canvas, left, baseline, "human", HUMAN, HUMAN_DASHES)
    if truth:
        _swatch(canvas, left, baseline, "ground truth", GROUND_TRUTH, TRUTH_DOTS)


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


def _swatch(
    canvas: Canvas,
    left: float,
    baseline: float,
    name: str,
    colour: Colour,
    pattern: tuple[float, float] | None = None,
) -> float:
    corners = np.array([[0, -10], [20, -10], [20, 1], [0, 1]])
    outline = corners + np.array([left, baseline])
    if pattern is None:
        canvas.lines(outline, colour, 1.5, closed=True)
    else:
        canvas.dashes(
            np.stack([outline, np.roll(outline, -1, axis=0)], axis=1), colour, 1.5, pattern
        )
    canvas.text(left + 28, baseline, name, TEXT)
    return left + 28 + text_width(name) + _GAP
