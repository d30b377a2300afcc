"""Weighted labels as pictures show them, and where their captions find room."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curate.viewing.canvas import Canvas
from curate.viewing.palette import DARK, Colour, Style, weight_colours
from curate.weighting.base import ZeroWeight

_LARGE, _SMALL = 14.0, 10.5
_LINE_PIXELS = (15.0, 12.0)
_MARGIN = 3.0
# A caption may lie over other boxes with this share of its area.
_COVERED_LIMIT = 0.4
_NEAR = 3.0
# Distances from its box at which a number is tried when the places beside the box are taken.
_FAR = (16.0, 32.0, 52.0, 76.0, 104.0, 140.0)
# Directions from a box, x to the right and y down: above first.
_SIDES = np.array([[0, -1], [1, 0], [-1, 0], [0, 1]])
_AROUND = np.array([[0, -1], [1, -1], [-1, -1], [1, 0], [-1, 0], [1, 1], [-1, 1], [0, 1]])


@dataclass(frozen=True)
class ShownLabels:
    """The labels of one frame with what a picture says about each.

    Attributes:
        boxes: (n, 7) in the LiDAR frame.
        categories: (n,) str.
        scores: (n,) in [0, 1].
        weights: (n,) in [0, 1]; NaN where the label has no weight.
        points: (n,) LiDAR points inside each box, or None where they were not counted.
        zero_weight: what a label of weight 0 is to a student, for the legend.
        numbers: (n,) k of each label in its frame; None for 0 to n - 1.
    """

    boxes: np.ndarray
    categories: np.ndarray
    scores: np.ndarray
    weights: np.ndarray
    points: np.ndarray | None = None
    zero_weight: ZeroWeight = "background"
    numbers: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.boxes)

    def colour(self, index: int, style: Style = DARK) -> Colour:
        """Return the colour of a label's weight."""
        red, green, blue = weight_colours(self.weights[index : index + 1], style)[0].tolist()
        return red, green, blue

    @property
    def emphasis(self) -> np.ndarray:
        """(n,) in [0, 1], how much a label stands out: its weight, or half where it has none."""
        return np.where(np.isnan(self.weights), 0.5, self.weights)

    def number(self, index: int) -> int:
        """Return the k of a label."""
        return index if self.numbers is None else int(self.numbers[index])

    def details(self, index: int) -> str:
        """Return category, score and LiDAR points of a label."""
        points = "" if self.points is None else f"  {self.points[index]} pts"
        return f"{self.categories[index]} {self.scores[index]:.2f}{points}"

    def caption(self, index: int) -> tuple[str, str]:
        """Return the two lines of a label's caption; without a weight the first line is empty."""
        name = self.short_caption(index)
        if self.weights[index] > 0:
            return f"{name}  {self.weights[index]:.2f}", self.details(index)
        return "", f"{name}  {self.details(index)}"

    def short_caption(self, index: int) -> str:
        """Return what is written where the caption finds no room."""
        return f"k{self.number(index)}"


@dataclass(frozen=True)
class ShownRepredictions:
    """The boxes of the augmented copies of a frame, mapped back.

    Attributes:
        boxes: (n, 7) in the LiDAR frame.
        weights: (n,) of the label that each was matched with; 0 where it was matched with none.
    """

    boxes: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True)
class Tag:
    """A caption and its place in the picture.

    Attributes:
        index: of the label.
        lines: of the caption; the first may be empty.
        place: (4,) left, top, right, bottom.
        beside: whether it is right beside its box; else a line leads there.
    """

    index: int
    lines: tuple[str, str]
    place: np.ndarray
    beside: bool = True


def draw_tags(
    canvas: Canvas,
    labels: ShownLabels,
    anchors: np.ndarray,
    bounds: np.ndarray,
    style: Style = DARK,
) -> None:
    """Write each label's caption beside its box, see `place_tags`.

    Args:
        canvas: drawn on.
        labels: the labels.
        anchors: (n, 4) left, top, right, bottom of each box in the picture; NaN: no caption.
        bounds: (4,) left, top, right, bottom of the room for captions.
        style: of the picture.
    """
    tags = place_tags(canvas, labels, anchors, bounds)
    for tag in tags:
        if not tag.beside:
            anchor = _clipped(anchors[tag.index], bounds)
            middle = (anchor[:2] + anchor[2:]) / 2
            near = np.clip(middle, tag.place[:2], tag.place[2:])
            canvas.lines(np.stack([middle, near]), labels.colour(tag.index, style), 1.0)
    for tag in tags:
        left, top, right, bottom = tag.place.tolist()
        colour = labels.colour(tag.index, style)
        heavy, light = tag.lines
        canvas.box(left, top, right, bottom, style.background, opacity=0.78)
        canvas.text(left + _MARGIN, top + _LINE_PIXELS[0] + 1, heavy, colour, _LARGE)
        faint = style.faint_text if heavy or not tag.beside else style.text
        canvas.text(left + _MARGIN, bottom - _MARGIN - 2, light, faint, _SMALL)


def place_tags(
    canvas: Canvas, labels: ShownLabels, anchors: np.ndarray, bounds: np.ndarray
) -> list[Tag]:
    """Return a caption for every label in the picture; they do not cover each other.

    First, labels by falling emphasis get their whole caption above, right, left or below the box,
    where it covers no other caption and little of other boxes. Each label that is left gets its
    short caption, which names it, at the nearest free place. Only where no place within reach is
    free does it lie over another one.

    Args:
        canvas: measures text.
        labels: the labels.
        anchors: (n, 4) left, top, right, bottom of each box in the picture; NaN: no caption.
        bounds: (4,) left, top, right, bottom of the room for captions.
    """
    clipped = np.array([_clipped(anchor, bounds) for anchor in anchors]).reshape(-1, 4)
    order = np.argsort(-labels.emphasis, kind="stable")
    seen = [int(i) for i in order if (clipped[i, 2:] > clipped[i, :2]).all()]
    boxes = clipped[seen]
    tags: list[Tag] = []
    left_out = []
    for i in seen:
        lines = labels.caption(i)
        places = _candidates(clipped[i], _size(canvas, lines), _SIDES, _NEAR)
        cost = [_cost(place, tags, boxes, clipped[i], bounds) for place in places]
        best = int(np.argmin(cost))
        if cost[best] < _COVERED_LIMIT:
            tags.append(Tag(i, lines, places[best]))
        else:
            left_out.append(i)
    for i in left_out:
        tags.append(_place_short(canvas, labels, i, tags, (boxes, clipped[i], bounds)))
    return tags


def _place_short(
    canvas: Canvas,
    labels: ShownLabels,
    index: int,
    tags: Sequence[Tag],
    around: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> Tag:
    """Return the short caption at the nearest place that is free."""
    boxes, anchor, bounds = around
    lines = ("", labels.short_caption(index))
    size = _size(canvas, lines)
    rings = [_candidates(anchor, size, _AROUND, gap) for gap in (_NEAR, *_FAR)]
    # The corner within its own box comes last: for a box that fills the picture.
    within = np.concatenate([anchor[:2] + _MARGIN, anchor[:2] + _MARGIN + size])
    for ring, places in enumerate([*rings, [within]]):
        cost = [_cost(place, tags, boxes, anchor, bounds) for place in places]
        best = int(np.argmin(cost))
        if cost[best] <= (_COVERED_LIMIT if ring == 0 else np.nextafter(np.inf, 0)):
            return Tag(index, lines, places[best], beside=ring in (0, len(rings)))
    low = np.clip(rings[0][0][:2], bounds[:2], bounds[2:] - size)
    return Tag(index, lines, np.concatenate([low, low + size]))


def _size(canvas: Canvas, lines: tuple[str, str]) -> np.ndarray:
    """(2,) width and height of a caption."""
    heavy, light = lines
    width = max(canvas.text_width(heavy, _LARGE), canvas.text_width(light, _SMALL))
    height = _LINE_PIXELS[1] + (_LINE_PIXELS[0] if heavy else 0)
    size: np.ndarray = np.array([width, height]) + 2 * _MARGIN
    return size


def _clipped(anchor: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return (4,) the part of a rectangle within bounds; empty where there is none."""
    low, high = np.tile(bounds[:2], 2), np.tile(bounds[2:], 2)
    clipped: np.ndarray = np.clip(np.nan_to_num(anchor, nan=-np.inf), low, high)
    return clipped


def _candidates(
    anchor: np.ndarray, size: np.ndarray, directions: np.ndarray, gap: float
) -> list[np.ndarray]:
    """Return rectangles at a distance from a box, in some directions."""
    middle = (anchor[:2] + anchor[2:]) / 2
    away = (anchor[2:] - anchor[:2]) / 2 + size / 2 + gap
    lows = middle + directions * away - size / 2
    return [np.concatenate([low, low + size]) for low in lows]


def _cost(
    place: np.ndarray,
    tags: Sequence[Tag],
    boxes: np.ndarray,
    own: np.ndarray,
    bounds: np.ndarray,
) -> float:
    """Return the share of a caption that lies over other boxes; infinite where it must not be."""
    if (place[:2] < bounds[:2]).any() or (place[2:] > bounds[2:]).any():
        return np.inf
    if tags and _common_area(place, np.array([tag.place for tag in tags])).any():
        return np.inf
    others = boxes[(boxes != own).any(axis=1)]
    return float(_common_area(place, others).sum() / np.prod(place[2:] - place[:2]))


def _common_area(place: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return (n,) areas that a rectangle shares with (n, 4) others."""
    low = np.maximum(place[:2], others[:, :2])
    high = np.minimum(place[2:], others[:, 2:])
    areas: np.ndarray = np.prod(np.maximum(high - low, 0), axis=1)
    return areas
