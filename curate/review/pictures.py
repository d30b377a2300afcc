"""The picture of a frame under review: image and bird's eye view with numbered boxes."""

from dataclasses import dataclass

import numpy as np

from curate.detections import as_categories
from curate.frames import Frame
from curate.review.sheet import ShownFrame
from curate.viewing.frame_view import draw_frame
from curate.viewing.tags import ShownLabels


@dataclass(frozen=True)
class NumberedLabels(ShownLabels):
    """Labels whose captions begin with their number.

    Attributes:
        asked: (n,) bool, on which an opinion is wanted; they stand out.
    """

    asked: np.ndarray | None = None

    @property
    def emphasis(self) -> np.ndarray:
        """(n,) in [0, 1]; what is asked about stands out."""
        return np.where(self._is_requested, 1.0, 0.25 + 0.25 * self.weights)

    def caption(self, index: int) -> tuple[str, str]:
        """The number, marked where an opinion is wanted; category, score and weight."""
        score, weight = self.scores[index], self.weights[index]
        mark = " ?" if self._is_requested[index] else ""
        return f"{index + 1}{mark}", f"{self.categories[index]} s {score:.2f} v {weight:.2f}"

    def short_caption(self, index: int) -> str:
        """The number alone."""
        return str(index + 1)

    @property
    def _is_requested(self) -> np.ndarray:
        return np.zeros(len(self), dtype=bool) if self.asked is None else self.asked


def draw_review(frame: Frame, shown: ShownFrame, *, title: str = "") -> np.ndarray:
    """(height, width, 3) uint8 RGB: the boxes with numbers, human labels dashed.

    Raises:
        DataError: the frame has no image.
    """
    human = np.array([box.human for box in shown.boxes], dtype=bool)
    labels = NumberedLabels(
        shown.array,
        as_categories([box.category for box in shown.boxes]),
        np.array([box.score for box in shown.boxes], dtype=np.float64),
        np.array([box.weight for box in shown.boxes], dtype=np.float64),
        asked=np.array([box.asked for box in shown.boxes], dtype=bool),
    )
    return draw_frame(frame, labels, human_boxes=shown.array[human], title=title)
