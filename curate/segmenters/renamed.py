"""A segmenter with other category names in its table of classes."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from curate.frames import Frame
from curate.segmenters.base import Segmenter, SemanticMap


class RenamedSegmenter(Segmenter):
    """A `Segmenter` with renamed categories; its maps stay the same.

    Args:
        segmenter: the segmenter.
        rename: the new name of each renamed category.
    """

    def __init__(self, segmenter: Segmenter, rename: Mapping[str, str]) -> None:
        self.segmenter = segmenter
        self.rename = dict(rename)
        self.needs_image = segmenter.needs_image
        # Assumed if the segmenter does not declare it.
        self.needs_points = bool(getattr(segmenter, "needs_points", True))

    def segment(self, frame: Frame) -> SemanticMap:
        """See `curate.segmenters.base.Segmenter`."""
        found = self.segmenter.segment(frame)
        classes = renamed_classes(found.category_classes, self.rename)
        return replace(found, category_classes=classes)


def renamed_classes(
    classes: Mapping[str, Sequence[int]], rename: Mapping[str, str]
) -> dict[str, tuple[int, ...]]:
    """Return a table of classes with renamed categories; the ids of equal names are joined."""
    table: dict[str, tuple[int, ...]] = {}
    for name, ids in classes.items():
        category = rename.get(name, name)
        table[category] = tuple(dict.fromkeys((*table.get(category, ()), *ids)))
    return table
