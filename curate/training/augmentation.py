"""Augmentation of training samples: pasted objects, flip, rotation and scale."""

from dataclasses import dataclass, replace

import numpy as np

from curate.detectors.base import Sample
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.geometry.similarity import Similarity
from curate.training.object_bank import ObjectBank, paste_objects


@dataclass(frozen=True)
class Augmentation:
    """Parameters of the augmentation.

    Attributes:
        flip_probability: probability of the mirror over the x axis.
        rotation_limit_rad: the rotation about z is uniform in plus or minus this angle.
        scale_range: lowest and highest scale; the scale is uniform in between.
        pasted: highest number of objects of each category that are pasted into a frame.
        fewest_points: an object with fewer points becomes an ignore region. An object that the
            sensor did not see, or that a pasted object hides, cannot be learned and is not
            background either.
    """

    flip_probability: float
    rotation_limit_rad: float
    scale_range: tuple[float, float]
    pasted: int
    fewest_points: int

    def apply(self, sample: Sample, bank: ObjectBank, generator: np.random.Generator) -> Sample:
        """Return an augmented copy of a sample; the input is not changed.

        Pseudo-labels of weight 0 that count as background are removed after pasting, so no object
        is pasted onto them. Boxes that have weight 0 in the result are ignore regions.
        """
        sample = _without_background(paste_objects(sample, bank, self.pasted, generator))
        visible = count_points_in_boxes(sample.points, sample.boxes) >= self.fewest_points
        similarity = Similarity.draw(
            generator,
            flip_probability=self.flip_probability,
            rotation_limit_rad=self.rotation_limit_rad,
            scale_range=self.scale_range,
        )
        return replace(
            sample,
            points=similarity.apply_to_points(sample.points),
            boxes=similarity.apply_to_boxes(sample.boxes),
            weights=np.where(visible, sample.weights, 0.0),
            zero_weight="ignore",
            regions=None,
        )


def _without_background(sample: Sample) -> Sample:
    """Return the sample without the boxes of weight 0 that count as background."""
    kept = (sample.weights > 0) | sample.ignored
    return replace(
        sample,
        boxes=sample.boxes[kept],
        categories=sample.categories[kept],
        weights=sample.weights[kept],
        regions=None if sample.regions is None else sample.regions[kept],
    )
