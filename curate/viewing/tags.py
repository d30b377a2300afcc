"""Weighted labels as pictures show them, and where their captions find room."""

from dataclasses import dataclass

import numpy as np

from curate.viewing.canvas import Canvas, Colour, text_width
from curate.viewing.palette import BACKGROUND, FAINT_TEXT, weight_colours
from curate.weighting.base import ZeroWeight

_LARGE, _SMALL = 14.0, 10.5
_LINE_PIXELS = (15.0, 12.0)
_MARGIN = 3.0
# A caption may lie over other boxes with this share of its area.
_COVERED_LIMIT = 0.4


@dataclass(frozen=True)
class ShownLabels:
    """The labels of one frame with what a picture tells about each.

    Attributes:
        boxes: (n, 7) in the LiDAR frame.
        categories: (n,) str.
        scores: (n,) in [0, 1].
        weights: (n,) in [0, 1]; NaN where nobody weighted the label.
        points: (n,) LiDAR points inside each box, or None where they were not counted.
        zero_weight: what a label of weight 0 is to a student, for the legend.
    """

    boxes: np.ndarray
    categories: np.ndarray
    scores: np.ndarray
    weights: np.ndarray
    points: np.ndarray | None = None
    zero_weight: ZeroWeight = "background"

    def __len__(self) -> int:
        return len(self.boxes)

    def colour(self, index: int) -> Colour:
        """The colour of a label's weight."""
        red, green, blue = weight_colours(self.weights[index : index + 1])[0].tolist()
        return red, green, blue

    @property
    def emphasis(self) -> np.ndarray:
        """(n,) in [0, 1], how much a label stands out: its weight, or half where it has none."""
        return np.where(np.isnan(self.weights), 0.5, self.weights)

    def caption(self, index: int) -> tuple[str, str]:
        """The two lines of a label's caption; the first is empty where the label weighs 0."""
        points = "" if self.points is None else f"  {self.points[index]} pts"
        weight = f"{self.weights[index]:.2f}" if self.weights[index] > 0 else ""
        return weight, f"{self.categories[index]} {self.scores[index]:.2f}{points}"

    def short_caption(self, index: int) -> str:
        """What is written where the caption finds no room; empty for nothing."""
        return "" if self.points is None else str(self.points[index])


@dataclass(frozen=True)
class ShownRepredictions:
    """The boxes of the augmented copies of a frame, mapped back.

    Attributes:
        boxes: (n, 7) in the LiDAR frame.
        weights: (n,) of the label that each was matched with; 0 where it was matched with none.
    """

    boxes: np.ndarray
    weights: np.ndarray


def draw_tags(canvas: Canvas, labels: ShownLabels, anchors: np.ndarray, bounds: np.ndarray) -> None:
    """Writes each label's caption beside its box where there is room, high weights first.

    A caption that would cover another one, or more than a little of any box, is left out; where
    the short one, the number of points, finds room, that is written.

    Args:
        canvas: drawn on.
        labels: the labels.
        anchors: (n, 4) left, top, right, bottom of each box in the picture; NaN: no caption.
        bounds: (4,) left, top, right, bottom of the room for captions.
    """
    taken: list[np.ndarray] = []
    shown = np.argsort(-labels.emphasis, kind="stable")
    left_out = []
    for index in shown[~np.isnan(anchors[shown]).any(axis=1)]:
        place = _place_tag(labels.caption(int(index)), int(index), anchors, taken, bounds)
        if place is None:
            left_out.append(int(index))
            continue
        taken.append(place)
        _draw_tag(canvas, place, labels.caption(int(index)), labels.colour(int(index)))
    for index in left_out:
        short = ("", labels.short_caption(index))
        place = _place_tag(short, index, anchors, taken, bounds) if short[1] else None
        if place is not None:
            taken.append(place)
            _draw_tag(canvas, place, short, labels.colour(index))


def _place_tag(
    lines: tuple[str, str],
    index: int,
    anchors: np.ndarray,
    taken: list[np.ndarray],
    bounds: np.ndarray,
) -> np.ndarray | None:
    """(4,) left, top, right, bottom of a caption beside its box; None where there is no room."""
    heavy, light = lines
    size = (
        max(text_width(heavy, _LARGE), text_width(light, _SMALL)),
        _LINE_PIXELS[1] + (_LINE_PIXELS[0] if heavy else 0),
    )
    places = _candidates(anchors[index], np.array(size) + 2 * _MARGIN)
    others = np.delete(anchors, index, axis=0)
    covered = [_covered(place, taken, others, bounds) for place in places]
    best = int(np.argmin(covered))
    return places[best] if covered[best] < _COVERED_LIMIT else None


def _draw_tag(canvas: Canvas, place: np.ndarray, lines: tuple[str, str], colour: Colour) -> None:
    left, top, right, bottom = place.tolist()
    canvas.box(left, top, right, bottom, BACKGROUND, opacity=0.72)
    canvas.text(left + _MARGIN, top + _LINE_PIXELS[0] + 1, lines[0], colour, _LARGE)
    canvas.text(left + _MARGIN, bottom - _MARGIN - 2, lines[1], FAINT_TEXT, _SMALL)


def _candidates(anchor: np.ndarray, size: np.ndarray) -> list[np.ndarray]:
    """Rectangles right of, left of, above and below a box."""
    (left, top, right, bottom), (width, height) = anchor, size
    middle_x, middle_y = (left + right - width) / 2, (top + bottom - height) / 2
    gap = 3.0
    corners = [
        (middle_x, top - height - gap),
        (right + gap, middle_y),
        (left - width - gap, middle_y),
        (middle_x, bottom + gap),
    ]
    return [np.array([x, y, x + width, y + height]) for x, y in corners]


def _covered(
    place: np.ndarray, taken: list[np.ndarray], boxes: np.ndarray, bounds: np.ndarray
) -> float:
    """Share of a caption that lies over boxes; infinite where it may not be."""
    if (place[:2] < bounds[:2]).any() or (place[2:] > bounds[2:]).any():
        return np.inf
    if taken and _common_area(place, np.array(taken)).any():
        return np.inf
    return float(np.nansum(_common_area(place, boxes)) / np.prod(place[2:] - place[:2]))


def _common_area(place: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(n,) areas that a rectangle shares with (n, 4) others."""
    low = np.maximum(place[:2], others[:, :2])
    high = np.minimum(place[2:], others[:, 2:])
    areas: np.ndarray = np.prod(np.maximum(high - low, 0), axis=1)
    return areas
