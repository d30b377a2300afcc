"""A raster canvas: it draws at twice the size and scales down at the end, for smooth edges.

Coordinates, line widths and text sizes are in pixels of the final image. `VectorCanvas` has the
same methods and draws vectors.
"""

from pathlib import Path
from typing import Self

import cv2
import numpy as np

from curate.files.atomic import replace_file
from curate.viewing.chart_style import ImageFormat
from curate.viewing.palette import Colour

_SUPER = 2
# OpenCV takes coordinates as integers with this many binary places.
_SHIFT = 4
_FONT = cv2.FONT_HERSHEY_SIMPLEX
# Height of a capital letter at font scale 1, in pixels.
_CAPITAL = 21.0


class Canvas:
    """An RGB image of a given size to draw on.

    Args:
        width: width of the final image.
        height: height of the final image.
        colour: background colour.
    """

    def __init__(self, width: int, height: int, colour: Colour) -> None:
        self.width, self.height = width, height
        self._pixels = np.full((height * _SUPER, width * _SUPER, 3), colour, np.uint8)

    def part(self, top: int, height: int) -> Self:
        """Return `height` rows from `top` as a canvas that clips what is drawn outside of it."""
        part = object.__new__(type(self))
        part.width, part.height = self.width, height
        part._pixels = self._pixels[top * _SUPER : (top + height) * _SUPER]
        return part

    def image(self, left: int, top: int, width: int, height: int, image: np.ndarray) -> None:
        """Draw an RGB image, scaled to (width, height)."""
        size = (width * _SUPER, height * _SUPER)
        scaled = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)
        rows = slice(top * _SUPER, top * _SUPER + size[1])
        self._pixels[rows, left * _SUPER : left * _SUPER + size[0]] = scaled

    def dots(self, places: np.ndarray, colours: np.ndarray) -> None:
        """Draw a small square at each of (n, 2) places in its (n, 3) colour, later ones on top."""
        at = np.floor(places * _SUPER).astype(int)
        for offset in np.ndindex(2, 2):
            column, row = (at + offset).T
            inside = (column >= 0) & (row >= 0) & (column < self.width * _SUPER)
            inside &= row < self.height * _SUPER
            self._pixels[row[inside], column[inside]] = colours[inside]

    def lines(
        self, strokes: np.ndarray, colour: Colour, width: float, *, closed: bool = False
    ) -> None:
        """Draw polylines (n, points, 2)."""
        thickness = max(1, round(width * _SUPER))
        cv2.polylines(
            self._pixels, list(_fixed(strokes)), closed, colour, thickness, cv2.LINE_AA, _SHIFT
        )

    def dashes(
        self, strokes: np.ndarray, colour: Colour, width: float, pattern: tuple[float, float]
    ) -> None:
        """Draw dashed line segments (n, 2, 2); `pattern` is the length of dash and gap."""
        dash, gap = pattern
        for start, end in strokes:
            length = float(np.linalg.norm(end - start))
            first, last = _inside(start, end, (self.width, self.height))
            at = np.arange(first // (dash + gap) * (dash + gap), last, dash + gap)
            if length == 0 or len(at) == 0:
                continue
            ends = np.minimum(np.stack([at, at + dash], axis=1), length) / length
            self.lines(start + ends[..., None] * (end - start), colour, width)

    def fill(self, outline: np.ndarray, colour: Colour, opacity: float) -> None:
        """Fill a convex polygon (points, 2), blended over the existing image."""
        shape = self._pixels.shape
        low = np.clip(np.floor(outline.min(axis=0) * _SUPER).astype(int) - 1, 0, shape[1::-1])
        high = np.clip(np.ceil(outline.max(axis=0) * _SUPER).astype(int) + 2, 0, shape[1::-1])
        if (high <= low).any():
            return
        region = self._pixels[low[1] : high[1], low[0] : high[0]]
        covered = region.copy()
        cv2.fillConvexPoly(covered, _fixed(outline - low / _SUPER)[0], colour, cv2.LINE_AA, _SHIFT)
        region[:] = cv2.addWeighted(covered, opacity, region, 1 - opacity, 0)

    def circle(self, centre: np.ndarray, radius: float, colour: Colour, width: float) -> None:
        """Draw a circle around a (2,) centre, as a polygon of 360 sides."""
        turn = np.linspace(0, 2 * np.pi, 361)[:-1]
        outline = centre + radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        self.lines(outline, colour, width, closed=True)

    def box(
        self,
        left: float,
        top: float,
        right: float,
        bottom: float,
        colour: Colour,
        opacity: float = 1.0,
    ) -> None:
        """Fill a rectangle with sharp edges, blended over the existing image."""
        edges = (np.array([left, top, right, bottom]) * _SUPER).round().astype(int).clip(0)
        region = self._pixels[edges[1] : edges[3], edges[0] : edges[2]]
        region[:] = np.rint(opacity * np.array(colour) + (1 - opacity) * region)

    def text(
        self, left: float, baseline: float, text: str, colour: Colour, size: float = 13.0
    ) -> None:
        """Draw a line of text; capital letters are about 0.7 `size` high."""
        at = (round(left * _SUPER), round(baseline * _SUPER))
        cv2.putText(self._pixels, text, at, _FONT, _font_scale(size), colour, 1, cv2.LINE_AA)

    def text_width(self, text: str, size: float = 13.0) -> float:
        """Return the width of a line of text."""
        (width, _), _ = cv2.getTextSize(text, _FONT, _font_scale(size), 1)
        return float(width) / _SUPER

    def content(self, kind: ImageFormat) -> bytes:
        """Return the content of an image file; this canvas supports only PNG."""
        if kind != "png":
            raise ValueError(kind)
        return png(self.finish())

    def finish(self) -> np.ndarray:
        """Return the final image, (height, width, 3) uint8 RGB."""
        size = (self.width, self.height)
        return np.asarray(cv2.resize(self._pixels, size, interpolation=cv2.INTER_AREA))


def png(rgb: np.ndarray) -> bytes:
    """Encode an (h, w, 3) uint8 RGB image as PNG."""
    _, content = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    return content.tobytes()


def save_png(path: Path, rgb: np.ndarray) -> None:
    """Write an (h, w, 3) uint8 RGB image as a PNG file, atomically."""
    replace_file(path, png(rgb))


def jpeg(rgb: np.ndarray, quality: int = 82) -> bytes:
    """Encode an (h, w, 3) uint8 RGB image as JPEG."""
    settings = [cv2.IMWRITE_JPEG_QUALITY, quality]
    _, content = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), settings)
    return content.tobytes()


def _inside(start: np.ndarray, end: np.ndarray, size: tuple[int, int]) -> tuple[float, float]:
    """Return the distances along a stroke at which it enters and leaves the image.

    (0, 0) means that the stroke is completely outside.
    """
    along = end - start
    low, high = 0.0, 1.0
    for axis in (0, 1):
        if along[axis] == 0:
            if not 0 <= start[axis] <= size[axis]:
                return 0.0, 0.0
            continue
        shares = sorted((edge - start[axis]) / along[axis] for edge in (0, size[axis]))
        low, high = max(low, shares[0]), min(high, shares[1])
    length = float(np.linalg.norm(along))
    return (low * length, high * length) if low < high else (0.0, 0.0)


def _font_scale(size: float) -> float:
    return size * 0.7 * _SUPER / _CAPITAL


def _fixed(outline: np.ndarray) -> np.ndarray:
    """Return places as OpenCV's fixed-point coordinates, (n, points, 2)."""
    places = np.rint(np.clip(outline * _SUPER, -30000, 30000) * 2**_SHIFT).astype(np.int32)
    polylines: np.ndarray = places.reshape(-1, *places.shape[-2:])
    return polylines
