"""Curves of a figure over a share, such as mean AP over labeled ratio, one line per method."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curate.viewing.canvas import Canvas, Colour, text_width
from curate.viewing.legend import STRIP_HEIGHT, TITLE_HEIGHT, draw_title
from curate.viewing.palette import BACKGROUND, FAINT_TEXT, GRID, PANEL, TEXT

_MARGIN, _GAP = 20, 14
_PANEL_WIDTH, _PANEL_HEIGHT = 560, 430
_LEFT, _TOP, _RIGHT, _BOTTOM = 56, 52, 150, 48  # of the plot within its panel
_LABEL_HEIGHT = 16.0
_BAND_OPACITY = 0.16
# Told apart by hue and by lightness.
_COLOURS: tuple[Colour, ...] = (
    (139, 150, 165), (222, 120, 92), (214, 164, 64), (92, 148, 222), (164, 118, 214),
    (66, 190, 168), (226, 120, 178), (250, 222, 72), (150, 200, 96), (110, 205, 235),
    (240, 240, 240),
)  # fmt: skip


@dataclass(frozen=True)
class Curve:
    """One line.

    Attributes:
        name: written at its end.
        means: (n,) a value per share; NaN where there is none.
        stds: (n,) half the height of its band; NaN for none.
    """

    name: str
    means: np.ndarray
    stds: np.ndarray


@dataclass(frozen=True)
class CurvePanel:
    """One plot of several lines over the same shares.

    Attributes:
        title: of the plot.
        shares: (n,) rising, above 0; the axis is logarithmic.
        curves: the lines.
    """

    title: str
    shares: np.ndarray
    curves: Sequence[Curve]


def draw_curves(panels: Sequence[CurvePanel], title: str, note: str) -> np.ndarray:
    """The picture: panels side by side.

    Args:
        panels: at least one.
        title: written at the top.
        note: written below, what line and band are.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    width = 2 * _MARGIN + len(panels) * _PANEL_WIDTH + (len(panels) - 1) * _GAP
    canvas = Canvas(width, TITLE_HEIGHT + 2 * _MARGIN + _PANEL_HEIGHT + STRIP_HEIGHT, BACKGROUND)
    draw_title(canvas, title, "")
    for number, panel in enumerate(panels):
        left = _MARGIN + number * (_PANEL_WIDTH + _GAP)
        top = TITLE_HEIGHT + _MARGIN
        canvas.box(left, top, left + _PANEL_WIDTH, top + _PANEL_HEIGHT, PANEL)
        canvas.text(left + 14, top + 27, panel.title, TEXT, 15)
        _Plot(canvas, left, top, panel).draw()
    strip = canvas.height - STRIP_HEIGHT
    canvas.box(0, strip, canvas.width, canvas.height, PANEL)
    canvas.text(14, strip + 25, note, FAINT_TEXT, 12)
    return canvas.finish()


class _Plot:
    """A panel's axes and the places of its values."""

    def __init__(self, canvas: Canvas, left: int, top: int, panel: CurvePanel) -> None:
        self.canvas, self.panel = canvas, panel
        self.left, self.right = left + _LEFT, left + _PANEL_WIDTH - _RIGHT
        self.top, self.bottom = top + _TOP, top + _PANEL_HEIGHT - _BOTTOM
        self.low, self.high, self.step = value_range(panel.curves)

    def draw(self) -> None:
        """Axes, bands, lines, names."""
        self._draw_axes()
        colours = [_COLOURS[i % len(_COLOURS)] for i in range(len(self.panel.curves))]
        for curve, colour in zip(self.panel.curves, colours, strict=True):
            self._draw_band(curve, colour)
        for curve, colour in zip(self.panel.curves, colours, strict=True):
            self._draw_line(curve, colour)
        self._draw_names(colours)

    def _across(self, share: float) -> float:
        ends = np.log(self.panel.shares[[0, -1]])
        if ends[0] == ends[1]:
            return (self.left + self.right) / 2
        place = (np.log(share) - ends[0]) / (ends[1] - ends[0])
        inset = 14
        return float(self.left + inset + place * (self.right - self.left - 2 * inset))

    def _down(self, value: float) -> float:
        place = np.clip((value - self.low) / (self.high - self.low), 0, 1)
        return float(self.bottom - place * (self.bottom - self.top))

    def _draw_axes(self) -> None:
        for value in np.arange(self.low, self.high + self.step / 2, self.step):
            down = self._down(value)
            self.canvas.lines(np.array([[self.left, down], [self.right, down]]), GRID, 1.0)
            number = f"{value:g}"
            left = self.left - 10 - text_width(number, 11)
            self.canvas.text(left, down + 4, number, FAINT_TEXT, 11)
        for share in self.panel.shares:
            across = self._across(share)
            self.canvas.lines(
                np.array([[across, self.bottom], [across, self.bottom + 4]]), FAINT_TEXT, 1.0
            )
            number = f"{100 * share:g} %"
            left = across - text_width(number, 11) / 2
            self.canvas.text(left, self.bottom + 20, number, FAINT_TEXT, 11)

    def _draw_band(self, curve: Curve, colour: Colour) -> None:
        known = ~np.isnan(curve.means) & ~np.isnan(curve.stds)
        for one, other in zip(*(np.flatnonzero(known)[edge] for edge in _PAIRS), strict=True):
            corners = [
                (
                    self._across(self.panel.shares[i]),
                    self._down(curve.means[i] + sign * curve.stds[i]),
                )
                for i, sign in ((one, 1), (other, 1), (other, -1), (one, -1))
            ]
            self.canvas.fill(np.array(corners), colour, _BAND_OPACITY)

    def _draw_line(self, curve: Curve, colour: Colour) -> None:
        known = np.flatnonzero(~np.isnan(curve.means))
        places = np.array(
            [(self._across(self.panel.shares[i]), self._down(curve.means[i])) for i in known]
        )
        if len(places) > 1:
            self.canvas.lines(places, colour, 2.0)
        for across, down in places:
            self.canvas.box(across - 3, down - 3, across + 3, down + 3, colour)
        if len(self.panel.shares) == 1:
            self._draw_whiskers(curve, colour)

    def _draw_whiskers(self, curve: Curve, colour: Colour) -> None:
        """The band of a single share, where it has no width."""
        if np.isnan([curve.means[0], curve.stds[0]]).any():
            return
        across = self._across(self.panel.shares[0])
        ends = [self._down(curve.means[0] + sign * curve.stds[0]) for sign in (-1, 1)]
        self.canvas.lines(np.array([[across, ends[0]], [across, ends[1]]]), colour, 1.5)

    def _draw_names(self, colours: Sequence[Colour]) -> None:
        """Each line's name beside its end, moved apart where they would overlap."""
        ends = []
        for curve, colour in zip(self.panel.curves, colours, strict=True):
            known = curve.means[~np.isnan(curve.means)]
            if len(known):
                ends.append((self._down(known[-1]), f"{curve.name}  {known[-1]:.1f}", colour))
        ends.sort(key=lambda end: end[0])
        places = spread_apart([end[0] for end in ends], _LABEL_HEIGHT, self.bottom)
        for place, (_, name, colour) in zip(places, ends, strict=True):
            self.canvas.text(self.right + 12, place + 4, name, colour, 12)


_PAIRS = (slice(None, -1), slice(1, None))  # each known place with the next one


def value_range(curves: Sequence[Curve]) -> tuple[float, float, float]:
    """Lowest and highest value of the axis, and the distance of its lines.

    All bands lie within, except that no axis of values above 0 begins below it.
    """
    reach = [np.nan_to_num(curve.stds) for curve in curves]
    lows = [curve.means - each for curve, each in zip(curves, reach, strict=True)]
    highs = [curve.means + each for curve, each in zip(curves, reach, strict=True)]
    values = np.concatenate([*lows, *highs]) if curves else np.zeros(0)
    values = values[~np.isnan(values)]
    if not len(values):
        return 0.0, 1.0, 0.5
    low, high = max(float(values.min()), 0.0), max(float(values.max()), 1e-3)
    rough = max(high - low, 0.1 * high) / 5
    power = 10.0 ** np.floor(np.log10(rough))
    step = float(next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough))
    low, high = step * np.floor(low / step), step * np.ceil(high / step)
    return float(low), float(max(high, low + step)), step


def spread_apart(places: Sequence[float], distance: float, end: float) -> list[float]:
    """Rising places moved as little downwards as keeps them apart, and up again from the end."""
    moved: list[float] = []
    for place in places:
        moved.append(max(place, moved[-1] + distance) if moved else place)
    for i in range(len(moved) - 1, -1, -1):
        limit = end if i == len(moved) - 1 else moved[i + 1] - distance
        moved[i] = min(moved[i], limit)
    return moved
