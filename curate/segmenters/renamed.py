"""A segmenter with other category names in its table of classes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from curate.frames import Frame
from curate.segmenters.base import Segmenter, SemanticMap


@dataclass(frozen=True)
class RenamedSegmenter:
    """A `Segmenter` whose categories are renamed; its maps stay the same.

    Attributes:
        segmenter: the segmenter.
        rename: the new name of each renamed category.
    """

    segmenter: Segmenter
    rename: Mapping[str, str]

    @property
    def needs_image(self) -> bool:
        """Whether the segmenter reads the image."""
        return self.segmenter.needs_image

    @property
    def needs_points(self) -> bool:
        """Whether the segmenter reads the points; assumed if it does not declare it."""
        return bool(getattr(self.segmenter, "needs_points", True))

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
