"""A canvas whose lines and texts are vectors, for PDF and SVG; drawn by matplotlib."""

from typing import Any, Self

import numpy as np

from curate.viewing.canvas import Canvas
from curate.viewing.chart_style import ImageFormat, figure_content, new_figure
from curate.viewing.palette import Colour

# A pixel of the canvas is a point of the page: 72 to the inch.
_POINTS = 72.0
# LiDAR points are too many for vectors: they become an image of this resolution.
_DPI = 216
_FONT = "DejaVu Sans"
# It has the capitals of the raster font at this share of its size.
_FONT_SHARE = 0.92


class VectorCanvas(Canvas):
    """An RGB picture of a given size, see `Canvas`."""

    def __init__(self, width: int, height: int, colour: Colour) -> None:
        self.width, self.height = width, height
        self._figure = new_figure(width / _POINTS, height / _POINTS)
        self._figure.set_facecolor(_rgb(colour))
        self._axes = self._figure.add_axes((0, 0, 1, 1))
        self._prepare(height)

    def part(self, top: int, height: int) -> Self:
        """Return the rows from `top` on as a canvas of its own; nothing leaves it."""
        part = object.__new__(type(self))
        part.width, part.height, part._figure = self.width, height, self._figure
        own = self._axes.get_position()
        share = own.height / self.height
        part._axes = self._figure.add_axes((0, own.y1 - (top + height) * share, 1, height * share))
        part._prepare(height)
        return part

    def image(self, left: int, top: int, width: int, height: int, image: np.ndarray) -> None:
        """Place an RGB image, embedded as it is."""
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
        """Draw straight strokes (n, 2, 2) as dashes."""
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
        """Write a line of text."""
        self._axes.text(
            left, baseline, text, color=_rgb(colour), fontsize=size * _FONT_SHARE,
            fontfamily=_FONT, zorder=self._next(), parse_math=False, clip_on=True,
        )  # fmt: skip

    def text_width(self, text: str, size: float = 13.0) -> float:
        """Return the width of a line of text of a size."""
        from matplotlib.font_manager import findfont, get_font

        font = get_font(findfont(_FONT))
        font.set_size(size * _FONT_SHARE, _POINTS)
        font.set_text(text)
        return float(font.get_width_height()[0]) / 64

    def content(self, kind: ImageFormat) -> bytes:
        """Return the content of a file."""
        placed = {"figure.constrained_layout.use": False}
        return figure_content(self._figure, kind, "picture", _DPI, **placed)

    def finish(self) -> np.ndarray:
        """Return the (height, width, 3) uint8 RGB picture."""
        self._figure.set_dpi(_POINTS)
        self._figure.canvas.draw()
        pixels: np.ndarray = np.asarray(self._figure.canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]
        return pixels

    def _prepare(self, height: int) -> None:
        self._axes.set_axis_off()
        self._axes.set(xlim=(0, self.width), ylim=(height, 0), autoscale_on=False)
        self._drawn = 0

    def _next(self) -> int:
        """Return the place in the order of drawing."""
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
