"""The batches of a training: which frames meet in a step, augmented."""

import numpy as np

from curate.detectors.base import Sample
from curate.errors import DataError
from curate.training.labels import WeightedLabels
from curate.training.object_bank import ObjectBank
from curate.training.settings import TrainingSettings


class Batches:
    """Makes the batch of any step.

    A batch depends on the labels, the settings and the number of the step only, so that a training
    that was killed goes on with the batches it would have seen.

    Args:
        labels: the frames to learn from.
        settings: of the training.

    Raises:
        DataError: no frame is labeled.
    """

    def __init__(self, labels: WeightedLabels, settings: TrainingSettings) -> None:
        self._labels = labels
        self._settings = settings
        self._augmentation = settings.augmentation()
        self._cache: dict[int, Sample] = {}
        self._room = settings.cache_bytes
        self.labeled = np.flatnonzero(labels.labeled)
        self.unlabeled = np.flatnonzero(~labels.labeled)
        if len(self.labeled) == 0:
            raise DataError("the label file holds no labeled frame; a training needs at least one")
        labeled = [self._sample(int(index)) for index in self.labeled]
        self.bank = ObjectBank.build(labeled, labels.categories, settings.fewest_points)
        known = sum(np.count_nonzero(~sample.ignored) for sample in labeled)
        self.objects_per_frame = max(known / len(labeled), 1.0)

    def __getitem__(self, step: int) -> list[Sample]:
        """Return the augmented samples of a step."""
        augmented = []
        for place, index in enumerate(self.chosen(step)):
            generator = np.random.default_rng([self._settings.seed, step, place])
            augmented.append(self._augmentation.apply(self._sample(index), self.bank, generator))
        return augmented

    def chosen(self, step: int) -> list[int]:
        """The frames of a step: X_l and X_u each run through in an order new for every pass."""
        of_unlabeled = self._settings.unlabeled_batch_size if len(self.unlabeled) else 0
        chosen = []
        for pool, count in (
            (self.labeled, self._settings.batch_size),
            (self.unlabeled, of_unlabeled),
        ):
            for turn in range(step * count, (step + 1) * count):
                seed = [self._settings.seed, turn // len(pool), int(pool is self.labeled)]
                order = np.random.default_rng(seed).permutation(len(pool))
                chosen.append(int(pool[order[turn % len(pool)]]))
        return chosen

    def _sample(self, index: int) -> Sample:
        """Return the sample as read, from memory where there was room for it."""
        if index in self._cache:
            return self._cache[index]
        sample = self._labels[index]
        if sample.points.nbytes <= self._room:
            self._room -= sample.points.nbytes
            self._cache[index] = sample
        return sample
