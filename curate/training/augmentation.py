"""What a training does to a sample before the network sees it: paste, flip, rotate, scale."""

from dataclasses import dataclass, replace

import numpy as np

from curate.detectors.base import Sample
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.geometry.similarity import Similarity
from curate.training.object_bank import ObjectBank, paste_objects


@dataclass(frozen=True)
class Augmentation:
    """How much samples are changed.

    Attributes:
        flip_probability: of the mirror over the x axis.
        rotation_limit_rad: rotation about z is uniform within plus and minus this.
        scale_range: uniform scale.
        pasted: objects of each category pasted into a frame, where there is room.
        fewest_points: an object with fewer points than this is an ignore region: what the sensor
            did not see, or what a pasted object hides, can neither be learned nor be background.
    """

    flip_probability: float
    rotation_limit_rad: float
    scale_range: tuple[float, float]
    pasted: int
    fewest_points: int

    def apply(self, sample: Sample, bank: ObjectBank, generator: np.random.Generator) -> Sample:
        """Return a new sample; the one given is left as it is.

        Pseudo-labels of weight 0 that are background are not in it; to what is pasted their place
        is taken. All that weighs 0 afterwards is an ignore region.
        """
        sample = _without_background(paste_objects(sample, bank, self.pasted, generator))
        seen = count_points_in_boxes(sample.points, sample.boxes) >= self.fewest_points
        change = Similarity.draw(
            generator,
            flip_probability=self.flip_probability,
            rotation_limit_rad=self.rotation_limit_rad,
            scale_range=self.scale_range,
        )
        return replace(
            sample,
            points=change.apply_to_points(sample.points),
            boxes=change.apply_to_boxes(sample.boxes),
            weights=np.where(seen, sample.weights, 0.0),
            zero_weight="ignore",
        )


def _without_background(sample: Sample) -> Sample:
    """Return the sample without the boxes of weight 0 that are background."""
    kept = (sample.weights > 0) | sample.ignored
    return replace(
        sample,
        boxes=sample.boxes[kept],
        categories=sample.categories[kept],
        weights=sample.weights[kept],
    )
