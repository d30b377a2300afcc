"""What every detector offers."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from curate.detections import Detections
from curate.frames import Frame
from curate.geometry.similarity import Similarity


class Detector(Protocol):
    """Finds boxes in a frame; raises `ModelError` where the model cannot be used as it is."""

    def predict(self, frame: Frame) -> Detections:
        """All boxes of the frame, low scores too, after non-maximum suppression.

        Boxes are in the frame of reference of `frame.points`, which the caller may have cropped
        to the camera's view or transformed by a similarity.
        """
        ...


@runtime_checkable
class RecordedViews(Protocol):
    """A detector whose answers for augmented copies were recorded: it dictates the augmentation."""

    def views(self, frame_id: str) -> Sequence[tuple[Similarity, Detections]]:
        """Each augmented copy A(x) of the frame with the detections in A's frame of reference."""
        ...
