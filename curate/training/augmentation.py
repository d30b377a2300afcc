"""What a training does to a sample before the network sees it: paste, flip, rotate, scale."""

from dataclasses import dataclass, replace

import numpy as np

from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.geometry.similarity import Similarity
from curate.training.labels import Sample
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
        zero_weight: what a pseudo-label of weight 0 is to the network, "ignore" or "background". To
            what is pasted its place is taken either way.
    """

    flip_probability: float
    rotation_limit_rad: float
    scale_range: tuple[float, float]
    pasted: int
    fewest_points: int
    zero_weight: str = "ignore"

    def apply(self, sample: Sample, bank: ObjectBank, generator: np.random.Generator) -> Sample:
        """A new sample; the one given is left as it is."""
        sample = paste_objects(sample, bank, self.pasted, generator)
        if self.zero_weight == "background" and not sample.labeled:
            sample = _without_ignored(sample)
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
        )


def _without_ignored(sample: Sample) -> Sample:
    """The sample without its boxes of weight 0."""
    learned = ~sample.ignored
    return replace(
        sample,
        boxes=sample.boxes[learned],
        categories=sample.categories[learned],
        weights=sample.weights[learned],
    )
