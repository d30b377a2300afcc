"""A canvas that draws lines and texts as vectors with matplotlib, for PDF and SVG."""

from typing import Any, Self

import numpy as np

from curate.viewing.canvas import Canvas
from curate.viewing.chart_style import ImageFormat, figure_content, new_figure
from curate.viewing.palette import Colour

# One pixel of the canvas is one point of the page, 1/72 inch.
_POINTS = 72.0
# There are too many LiDAR points for vectors: they are rasterized at this resolution.
_DPI = 216
_FONT = "DejaVu Sans"
# At this share of the size, its capital letters are as high as those of the raster font.
_FONT_SHARE = 0.92


class VectorCanvas(Canvas):
    """A vector canvas with the interface of `Canvas`."""

    def __init__(self, width: int, height: int, colour: Colour) -> None:
        self.width, self.height = width, height
        self._figure = new_figure(width / _POINTS, height / _POINTS)
        self._figure.set_facecolor(_rgb(colour))
        self._axes = self._figure.add_axes((0, 0, 1, 1))
        self._prepare(height)

    def part(self, top: int, height: int) -> Self:
        """Return `height` rows from `top` as a canvas that clips what is drawn outside of it."""
        part = object.__new__(type(self))
        part.width, part.height, part._figure = self.width, height, self._figure
        whole = self._axes.get_position()
        share = whole.height / self.height
        bottom = whole.y1 - (top + height) * share
        part._axes = self._figure.add_axes((0, bottom, 1, height * share))
        part._prepare(height)
        return part

    def image(self, left: int, top: int, width: int, height: int, image: np.ndarray) -> None:
        """Draw an RGB image; it is embedded at its own resolution."""
        extent = (left, left + width, top + height, top)
        self._axes.imshow(
            image, extent=extent, aspect="auto", interpolation="none", zorder=self._next()
        )

    def dots(self, places: np.ndarray, colours: np.ndarray) -> None:
        """Draw a small square at each of (n, 2) places in its (n, 3) colour."""
        inside = ((places >= 0) & (places <= (self.width, self.height))).all(axis=1)
        x, y = places[inside].T
        self._axes.scatter(
            x, y, 1.0, colours[inside] / 255, marker="s", linewidths=0, rasterized=True,
            zorder=self._next(),
        )  # fmt: skip

    def lines(
        self, strokes: np.ndarray, colour: Colour, width: float, *, closed: bool = False
    ) -> None:
        """Draw polylines (n, points, 2) of one width."""
        strokes = strokes.reshape(-1, *strokes.shape[-2:])
        if closed:
            strokes = np.concatenate([strokes, strokes[:, :1]], axis=1)
        self._add_lines(strokes, colour, width, linestyles="solid")

    def dashes(
        self, strokes: np.ndarray, colour: Colour, width: float, pattern: tuple[float, float]
    ) -> None:
        """Draw dashed line segments (n, 2, 2); `pattern` is the length of dash and gap."""
        dash, gap = pattern
        self._add_lines(
            strokes, colour, width, linestyles=[(0, (dash / width, gap / width))], capstyle="butt"
        )

    def fill(self, outline: np.ndarray, colour: Colour, opacity: float) -> None:
        """Fill a convex polygon (points, 2)."""
        from matplotlib.patches import Polygon

        shape = Polygon(outline, fc=_rgb(colour), ec="none", alpha=opacity, zorder=self._next())
        self._axes.add_patch(shape)

    def box(
        self, left: float, top: float, right: float, bottom: float, colour: Colour,
        opacity: float = 1.0,
    ) -> None:  # fmt: skip
        """Fill a rectangle."""
        corners = [[left, top], [right, top], [right, bottom], [left, bottom]]
        self.fill(np.array(corners), colour, opacity)

    def text(
        self, left: float, baseline: float, text: str, colour: Colour, size: float = 13.0
    ) -> None:
        """Draw a line of text."""
        self._axes.text(
            left, baseline, text, color=_rgb(colour), fontsize=size * _FONT_SHARE,
            fontfamily=_FONT, zorder=self._next(), parse_math=False, clip_on=True,
        )  # fmt: skip

    def text_width(self, text: str, size: float = 13.0) -> float:
        """Return the width of a line of text."""
        from matplotlib.font_manager import findfont, get_font

        font = get_font(findfont(_FONT))
        font.set_size(size * _FONT_SHARE, _POINTS)
        font.set_text(text)
        return float(font.get_width_height()[0]) / 64

    def content(self, kind: ImageFormat) -> bytes:
        """Return the content of an image file."""
        placed = {"figure.constrained_layout.use": False}
        return figure_content(self._figure, kind, "picture", _DPI, **placed)

    def finish(self) -> np.ndarray:
        """Return the image, (height, width, 3) uint8 RGB."""
        self._figure.set_dpi(_POINTS)
        self._figure.canvas.draw()
        pixels: np.ndarray = np.asarray(self._figure.canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]
        return pixels

    def _prepare(self, height: int) -> None:
        self._axes.set_axis_off()
        self._axes.set(xlim=(0, self.width), ylim=(height, 0), autoscale_on=False)
        self._drawn = 0

    def _next(self) -> int:
        """Return the next position in the drawing order."""
        self._drawn += 1
        return self._drawn

    def _add_lines(self, strokes: np.ndarray, colour: Colour, width: float, **how: Any) -> None:
        from matplotlib.collections import LineCollection

        lines = LineCollection(
            list(strokes), colors=[_rgb(colour)], linewidths=width, zorder=self._next(), **how
        )
        self._axes.add_collection(lines, autolim=False)


def _rgb(colour: Colour) -> tuple[float, float, float]:
    red, green, blue = colour
    return red / 255, green / 255, blue / 255
