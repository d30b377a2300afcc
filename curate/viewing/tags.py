"""The labels of a drawn frame, and the placement of their captions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curate.viewing.canvas import Canvas
from curate.viewing.palette import DARK, Colour, Style, weight_colours
from curate.weighting.base import ZeroWeight

_LARGE, _SMALL = 14.0, 10.5
_LINE_PIXELS = (15.0, 12.0)
_MARGIN = 3.0
# At most this share of a caption's area may cover other boxes.
_COVERED_LIMIT = 0.4
_NEAR = 3.0
# Distances from the box to try for a short caption when the places beside the box are occupied.
_FAR = (16.0, 32.0, 52.0, 76.0, 104.0, 140.0)
# Directions from a box, x to the right and y down: above first.
_SIDES = np.array([[0, -1], [1, 0], [-1, 0], [0, 1]])
_AROUND = np.array([[0, -1], [1, -1], [-1, -1], [1, 0], [-1, 0], [1, 1], [-1, 1], [0, 1]])


@dataclass(frozen=True)
class ShownLabels:
    """The labels of one frame, with the data for their captions.

    Attributes:
        boxes: (n, 7) in the LiDAR frame.
        categories: (n,) str.
        scores: (n,) in [0, 1].
        weights: (n,) in [0, 1]; NaN for labels without a weight.
        points: (n,) LiDAR points inside each box; None if they were not counted.
        zero_weight: the meaning of weight 0, for the legend.
        numbers: (n,) k of each label in its frame; None for 0 to n - 1.
        decisions: (n,) str, what a person decided about each label: accepted, moved, added,
            rejected, or ""; None if nobody decided.
        unseen: (n,) bool, labels that no camera of the frame shows; None if there is no camera.
    """

    boxes: np.ndarray
    categories: np.ndarray
    scores: np.ndarray
    weights: np.ndarray
    points: np.ndarray | None = None
    zero_weight: ZeroWeight = "background"
    numbers: np.ndarray | None = None
    decisions: np.ndarray | None = None
    unseen: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.boxes)

    def colour(self, index: int, style: Style = DARK) -> Colour:
        """Return the colour of a label's weight."""
        red, green, blue = weight_colours(self.weights[index : index + 1], style)[0].tolist()
        return red, green, blue

    @property
    def emphasis(self) -> np.ndarray:
        """(n,) in [0, 1], how strongly to draw each label: its weight, or 0.5 without one."""
        return np.where(np.isnan(self.weights), 0.5, self.weights)

    @property
    def is_rejected(self) -> np.ndarray:
        """(n,) bool, labels that a person rejected; they are crossed out."""
        return self._decided == "rejected"

    @property
    def is_human(self) -> np.ndarray:
        """(n,) bool, objects that a person accepted, moved or added; they have long dashes."""
        return (self._decided != "") & ~self.is_rejected

    @property
    def _decided(self) -> np.ndarray:
        none = np.full(len(self), "", dtype="U8")
        return none if self.decisions is None else self.decisions

    def number(self, index: int) -> int:
        """Return the k of a label."""
        return index if self.numbers is None else int(self.numbers[index])

    def details(self, index: int) -> str:
        """Return category, score and LiDAR points of a label, and the decision of a person."""
        points = "" if self.points is None else f"  {self.points[index]} pts"
        decision = self._decided[index]
        score = "" if self.is_human[index] else f" {self.scores[index]:.2f}"
        person = f"  {decision} by a person" if decision else ""
        return f"{self.categories[index]}{score}{person}{points}"

    def caption(self, index: int) -> tuple[str, str]:
        """Return the two lines of a caption; the first is empty unless the weight is above 0."""
        name = f"k{self.number(index)}"
        if self.weights[index] > 0:
            return f"{name}  {self.weights[index]:.2f}", self.details(index)
        return "", f"{name}  {self.details(index)}"

    def short_caption(self, index: int) -> str:
        """Return the caption to use if there is no room for the full one."""
        return f"k{self.number(index)} {self._decided[index]}".rstrip()


@dataclass(frozen=True)
class ShownRepredictions:
    """The boxes of the augmented copies of a frame, mapped back.

    Attributes:
        boxes: (n, 7) in the LiDAR frame.
        weights: (n,) weight of the matched label; 0 without a match.
    """

    boxes: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True)
class Tag:
    """A caption and its place in the image.

    Attributes:
        index: index of the label.
        lines: the two lines of the caption; the first may be empty.
        place: (4,) left, top, right, bottom.
        beside: True if the caption is next to its box; otherwise a line connects them.
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
    """Draw the captions of all labels, see `place_tags`.

    Args:
        canvas: the canvas to draw on.
        labels: the labels.
        anchors: (n, 4) left, top, right, bottom of each box in the image; NaN for no caption.
        bounds: (4,) left, top, right, bottom of the area for captions.
        style: style of the image.
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
    """Return a caption for every label in the image, without overlaps if possible.

    First the labels get, by falling emphasis, their full caption above, right, left or below the
    box, if it covers no other caption and little of other boxes there. Each remaining label gets
    its short caption at the nearest free place. A short caption covers another one only if all
    places within reach are occupied.

    Args:
        canvas: the canvas, used to measure text.
        labels: the labels.
        anchors: (n, 4) left, top, right, bottom of each box in the image; NaN for no caption.
        bounds: (4,) left, top, right, bottom of the area for captions.
    """
    clipped = np.array([_clipped(anchor, bounds) for anchor in anchors]).reshape(-1, 4)
    order = np.argsort(-labels.emphasis, kind="stable")
    seen = [int(i) for i in order if (clipped[i, 2:] > clipped[i, :2]).all()]
    boxes = clipped[seen]
    tags: list[Tag] = []
    remaining = []
    for i in seen:
        lines = labels.caption(i)
        places = _candidates(clipped[i], _size(canvas, lines), _SIDES, _NEAR)
        cost = [_cost(place, tags, boxes, clipped[i], bounds) for place in places]
        best = int(np.argmin(cost))
        if cost[best] < _COVERED_LIMIT:
            tags.append(Tag(i, lines, places[best]))
        else:
            remaining.append(i)
    for i in remaining:
        tags.append(_place_short(canvas, labels, i, tags, (boxes, clipped[i], bounds)))
    return tags


def _place_short(
    canvas: Canvas,
    labels: ShownLabels,
    index: int,
    tags: Sequence[Tag],
    around: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> Tag:
    """Return the short caption at the nearest free place."""
    boxes, anchor, bounds = around
    lines = ("", labels.short_caption(index))
    size = _size(canvas, lines)
    rings = [_candidates(anchor, size, _AROUND, gap) for gap in (_NEAR, *_FAR)]
    # The last place is the corner inside the box, for a box that fills the image.
    within = np.concatenate([anchor[:2] + _MARGIN, anchor[:2] + _MARGIN + size])
    for ring, places in enumerate([*rings, [within]]):
        cost = [_cost(place, tags, boxes, anchor, bounds) for place in places]
        best = int(np.argmin(cost))
        if cost[best] <= (_COVERED_LIMIT if ring == 0 else np.nextafter(np.inf, 0)):
            return Tag(index, lines, places[best], beside=ring in (0, len(rings)))
    low = np.clip(rings[0][0][:2], bounds[:2], bounds[2:] - size)
    return Tag(index, lines, np.concatenate([low, low + size]))


def _size(canvas: Canvas, lines: tuple[str, str]) -> np.ndarray:
    """Return (2,) width and height of a caption."""
    heavy, light = lines
    width = max(canvas.text_width(heavy, _LARGE), canvas.text_width(light, _SMALL))
    height = _LINE_PIXELS[1] + (_LINE_PIXELS[0] if heavy else 0)
    size: np.ndarray = np.array([width, height]) + 2 * _MARGIN
    return size


def _clipped(anchor: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return (4,) the part of a rectangle within bounds, which may be empty."""
    low, high = np.tile(bounds[:2], 2), np.tile(bounds[2:], 2)
    clipped: np.ndarray = np.clip(np.nan_to_num(anchor, nan=-np.inf), low, high)
    return clipped


def _candidates(
    anchor: np.ndarray, size: np.ndarray, directions: np.ndarray, gap: float
) -> list[np.ndarray]:
    """Return one rectangle per direction, at a distance `gap` from a box."""
    middle = (anchor[:2] + anchor[2:]) / 2
    away = (anchor[2:] - anchor[:2]) / 2 + size / 2 + gap
    lows = middle + directions * away - size / 2
    return [np.concatenate([low, low + size]) for low in lows]


def _cost(
    place: np.ndarray,
    tags: Sequence[Tag],
    boxes: np.ndarray,
    anchor: np.ndarray,
    bounds: np.ndarray,
) -> float:
    """Return the share of a caption that covers other boxes; infinite for a forbidden place.

    A place is forbidden if it is outside the bounds or covers another caption.
    """
    if (place[:2] < bounds[:2]).any() or (place[2:] > bounds[2:]).any():
        return np.inf
    if tags and _common_area(place, np.array([tag.place for tag in tags])).any():
        return np.inf
    others = boxes[(boxes != anchor).any(axis=1)]
    return float(_common_area(place, others).sum() / np.prod(place[2:] - place[:2]))


def _common_area(place: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return (n,) the intersection areas of a rectangle with (n, 4) others."""
    low = np.maximum(place[:2], others[:, :2])
    high = np.minimum(place[2:], others[:, 2:])
    areas: np.ndarray = np.prod(np.maximum(high - low, 0), axis=1)
    return areas
