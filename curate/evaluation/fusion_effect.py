"""The effect of fused boxes: the share of correct labels before and after fusion.

The labels are the same, only their boxes differ. The intervals come from the same draws of frames
for both shares, so the difference is a paired one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curate.evaluation.audit import Estimate
from curate.evaluation.evaluated_labels import ALL, EvaluatedLabels
from curate.evaluation.reliability import Overlap
from curate.evaluation.resampling import draw_frames


@dataclass(frozen=True)
class FusionEffect:
    """The share of correct labels of a category before and after fusion.

    Attributes:
        overlap: the overlap that makes a label correct, "bev" or "3d".
        category: the category, or `ALL`.
        labels: number of labels that are correct or wrong, with the box before fusion.
        before: share of correct labels with the boxes of the detector.
        after: share of correct labels with the fused boxes.
        difference: after - before.
    """

    overlap: Overlap
    category: str
    labels: int
    before: Estimate
    after: Estimate
    difference: Estimate

    @property
    def beyond_chance(self) -> bool:
        """Whether the interval of the difference excludes 0."""
        return self.difference.low > 0 or self.difference.high < 0


def fusion_effects(
    overlap: Overlap,
    parts: Sequence[tuple[EvaluatedLabels, EvaluatedLabels]],
    categories: Sequence[str],
    generator: np.random.Generator,
    *,
    replicates: int = 1000,
    level: float = 0.95,
) -> tuple[FusionEffect, ...]:
    """Return the effect on all labels, and on those of each category.

    Args:
        overlap: the overlap by which the labels were evaluated.
        parts: the labels with the boxes of the detector, and the same labels with fused boxes; one
            pair for each fold of an audit.
        categories: the categories to evaluate.
        generator: random generator for the bootstrap over frames.
        replicates: number of bootstrap draws.
        level: coverage of the intervals.
    """
    before, after = map(EvaluatedLabels.joined, zip(*parts, strict=True))
    draws = draw_frames(generator, before.frames, replicates)
    found = []
    for category in (ALL, *categories):
        of_before, of_after = (_counts(each, category) for each in (before, after))
        values = [float(_share(*each.sum(axis=1))) for each in (of_before, of_after)]
        drawn = [_share(*(each @ draws.T)) for each in (of_before, of_after)]
        found.append(
            FusionEffect(
                overlap=overlap,
                category=category,
                labels=int(of_before[1].sum()),
                before=Estimate.of(values[0], drawn[0], level),
                after=Estimate.of(values[1], drawn[1], level),
                difference=Estimate.of(values[1] - values[0], drawn[1] - drawn[0], level),
            )
        )
    return tuple(found)


def _counts(labels: EvaluatedLabels, category: str) -> np.ndarray:
    """Return the (2, f) numbers of correct and of counted labels in each frame."""
    chosen = labels.counted & ((category == ALL) | (labels.category == category))
    return np.stack(
        [
            np.bincount(labels.frame_index[which], minlength=labels.frames)
            for which in (chosen & labels.correct, chosen)
        ]
    )


def _share(correct: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """Return correct / counted, NaN without any."""
    return np.asarray(correct / np.where(counted > 0, counted, np.nan))
