"""The labels of a round that rank highest, found block by block."""

from dataclasses import dataclass, field

import numpy as np

from pipelines.labels.columns import LabelColumns


@dataclass(frozen=True)
class RankedLabel:
    """A label and its rank.

    Attributes:
        rank: above 0.
        frame: its frame.
        k: its number there.
        category: its category.
        box: (7,) in the LiDAR frame.
        numbers: of `weighted_labels` by name; NaN for null.
    """

    rank: float
    frame: str
    k: int
    category: str
    box: np.ndarray
    numbers: dict[str, float]


@dataclass
class Ranking:
    """The labels with the highest rank above 0 so far.

    Attributes:
        count: how many are kept.
        labels: the highest first; of equals the one that came first.
    """

    count: int
    labels: list[RankedLabel] = field(default_factory=list)

    def add(self, labels: LabelColumns, rank: np.ndarray) -> None:
        """A block of labels with their (n,) ranks more."""
        first = np.argsort(-rank, kind="stable")[: self.count]
        found = [
            RankedLabel(
                float(rank[i]),
                labels.frame_names[labels.frames[i]],
                int(labels.k[i]),
                labels.category_names[labels.categories[i]],
                labels.boxes[i].copy(),
                {name: float(values[i]) for name, values in labels.numbers.items()},
            )
            for i in first[rank[first] > 0].tolist()
        ]
        self.labels = sorted([*self.labels, *found], key=lambda each: -each.rank)[: self.count]
