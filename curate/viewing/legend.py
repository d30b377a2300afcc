"""Draw the title strip above an image and the legend strip below it."""

import numpy as np

from curate.viewing.canvas import Canvas
from curate.viewing.palette import DARK, Colour, Style, weight_colours
from curate.weighting.base import ZeroWeight

STRIP_HEIGHT = 40
TITLE_HEIGHT = 36

# Lengths of dash and gap in pixels: the line style shows the origin of a box.
REPREDICTION_DASHES = (6.0, 4.0)
TRUTH_DOTS = (1.5, 3.0)
HUMAN_DASHES = (12.0, 3.0)
# Width of the cross in a label that no camera shows.
UNSEEN_STROKE = 1.0

_BAR_PIXELS = 120
_GAP = 24.0
_ZERO_WEIGHT_WORDS = {"background": "v = 0: background", "ignore": "v = 0: ignored"}


def draw_title(canvas: Canvas, title: str, note: str, style: Style = DARK) -> None:
    """Draw the strip at the top: a title on the left and a note on the right."""
    canvas.box(0, 0, canvas.width, TITLE_HEIGHT, style.panel)
    canvas.text(14, 24, title, style.text, 16)
    left = canvas.width - 14 - canvas.text_width(note, 12)
    canvas.text(left, 23, note, style.faint_text, 12)


def draw_legend(
    canvas: Canvas,
    *,
    truth: bool,
    zero_weight: ZeroWeight = "background",
    repredictions: bool = False,
    unweighted: bool = False,
    human: bool = False,
    rejected: bool = False,
    unseen: bool = False,
    style: Style = DARK,
) -> None:
    """Draw the strip at the bottom: the weight scale, and the line styles that are used."""
    top = canvas.height - STRIP_HEIGHT
    canvas.box(0, top, canvas.width, canvas.height, style.panel)
    baseline = top + 25.0
    left = _weight_bar(canvas, 14.0, top + 13.0, baseline, style)
    entries: list[tuple[bool, str, Colour, tuple[float, float] | None]] = [
        (True, _ZERO_WEIGHT_WORDS[zero_weight], style.zero_weight, None),
        (unweighted, "not weighted", style.unweighted, None),
        (repredictions, "prediction", style.text, None),
        (repredictions, "reprediction", style.text, REPREDICTION_DASHES),
        (human, "human", style.human, HUMAN_DASHES),
        (rejected, "rejected by a person", style.zero_weight, None),
        (truth, "ground truth", style.ground_truth, TRUTH_DOTS),
    ]
    for shown, name, colour, pattern in entries:
        if shown:
            outline = _swatch(canvas, (left, baseline), colour, pattern)
            if name.startswith("rejected"):
                draw_cross(canvas, outline, style)
            canvas.text(left + 28, baseline, name, style.text)
            left += 28 + canvas.text_width(name) + _GAP
    if unseen:
        outline = _swatch(canvas, (left, baseline), style.text, None)
        canvas.lines(outline[[[0, 2], [1, 3]]], style.text, UNSEEN_STROKE)
        canvas.text(left + 28, baseline, "no image evidence", style.text)


def draw_cross(canvas: Canvas, corners: np.ndarray, style: Style = DARK) -> None:
    """Draw both diagonals of a (4, 2) quadrilateral: a person rejected this label."""
    canvas.lines(corners[[0, 2]], style.human, 1.5)
    canvas.lines(corners[[1, 3]], style.human, 1.5)


def _weight_bar(canvas: Canvas, left: float, top: float, baseline: float, style: Style) -> float:
    """Draw the colour bar from 0 to 1 and return the left edge of the next entry."""
    for text, colour, gap in (("weight v", style.text, 10), ("0", style.faint_text, 6)):
        canvas.text(left, baseline, text, colour)
        left += canvas.text_width(text) + gap
    colours = weight_colours(np.linspace(1e-6, 1, _BAR_PIXELS), style)
    for offset, (red, green, blue) in enumerate(colours.tolist()):
        canvas.box(left + offset, top, left + offset + 1, top + 14, (red, green, blue))
    left += _BAR_PIXELS + 6
    canvas.text(left, baseline, "1", style.faint_text)
    return left + canvas.text_width("1") + _GAP


def _swatch(
    canvas: Canvas,
    place: tuple[float, float],
    colour: Colour,
    pattern: tuple[float, float] | None,
) -> np.ndarray:
    """Draw an outline and return its (4, 2) corners."""
    corners = np.array([[0, -10], [20, -10], [20, 1], [0, 1]])
    outline: np.ndarray = corners + np.array(place)
    if pattern is None:
        canvas.lines(outline, colour, 1.5, closed=True)
    else:
        sides = np.stack([outline, np.roll(outline, -1, axis=0)], axis=1)
        canvas.dashes(sides, colour, 1.5, pattern)
    return outline
