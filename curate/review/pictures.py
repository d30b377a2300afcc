"""Images of frames under review: camera image and bird's eye view with numbered boxes."""

from dataclasses import dataclass

import numpy as np

from curate.detections import as_categories
from curate.frames import Frame
from curate.review.sheet import ShownFrame
from curate.viewing.frame_view import draw_frame
from curate.viewing.tags import ShownLabels


@dataclass(frozen=True)
class NumberedLabels(ShownLabels):
    """Labels with their k as the first part of their caption, and a mark on requested ones.

    Attributes:
        requested: (n,) bool, labels for which a decision is requested; they are highlighted.
    """

    requested: np.ndarray | None = None

    @property
    def emphasis(self) -> np.ndarray:
        """(n,) in [0, 1]; 1 if a decision is requested."""
        return np.where(self._is_requested, 1.0, 0.25 + 0.25 * self.weights)

    def caption(self, index: int) -> tuple[str, str]:
        """Return k, with a mark if a decision is requested, and category, s and v.

        A proposal has no weight, and neither s nor v.
        """
        score, weight = self.scores[index], self.weights[index]
        mark = " ?" if self._is_requested[index] else ""
        name = f"k{self.number(index)}{mark}"
        if np.isnan(weight):
            return name, f"{self.categories[index]}, proposal"
        return name, f"{self.categories[index]} s {score:.2f} v {weight:.2f}"

    @property
    def _is_requested(self) -> np.ndarray:
        return np.zeros(len(self), dtype=bool) if self.requested is None else self.requested


def draw_review(frame: Frame, shown: ShownFrame, *, title: str = "") -> np.ndarray:
    """Draw the numbered boxes, human labels dashed; return (height, width, 3) uint8 RGB."""
    labels = NumberedLabels(
        shown.array,
        as_categories([box.category for box in shown.boxes]),
        np.array([box.score for box in shown.boxes], dtype=np.float64),
        np.array([np.nan if box.is_proposal else box.weight for box in shown.boxes]),
        numbers=np.array([box.k for box in shown.boxes], dtype=np.int64),
        decisions=np.array(["human" if box.human else "" for box in shown.boxes], dtype="U8"),
        requested=np.array([box.asked for box in shown.boxes], dtype=bool),
    )
    return draw_frame(frame, labels, title=title)
