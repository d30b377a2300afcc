"""Batches of a training: the augmented frames of each step."""

import copy
from typing import Self

import numpy as np

from curate.detectors.base import Sample
from curate.errors import DataError
from curate.training.labels import WeightedLabels
from curate.training.object_bank import ObjectBank
from curate.training.settings import TrainingSettings


class Batches:
    """The batches of a training by step number, or the part of them that one process trains on.

    A batch depends only on the labels, the settings and the step number. A killed training
    therefore resumes with the same batches, and several processes split the batch of one.

    Args:
        labels: the training frames.
        settings: settings of the training.
        rank: number of this process.
        processes: number of processes that split each batch.

    Raises:
        DataError: if no frame is labeled.
    """

    def __init__(
        self,
        labels: WeightedLabels,
        settings: TrainingSettings,
        rank: int = 0,
        processes: int = 1,
    ) -> None:
        self._labels = labels
        self._settings = settings
        self._rank, self._processes = rank, processes
        self._augmentation = settings.augmentation()
        self._cache: dict[int, Sample] = {}
        self._free_cache_bytes = settings.cache_bytes // processes
        self.labeled = np.flatnonzero(labels.labeled)
        self.unlabeled = np.flatnonzero(~labels.labeled)
        if len(self.labeled) == 0:
            raise DataError("the label file has no labeled frame; training needs at least one")
        labeled = [self._sample(int(index)) for index in self.labeled]
        self.bank = ObjectBank.build(labeled, labels.categories, settings.fewest_points)
        objects = sum(np.count_nonzero(~sample.ignored) for sample in labeled)
        self.objects_per_frame = max(objects / len(labeled), 1.0)

    def __getitem__(self, step: int) -> list[Sample]:
        """Return this process's augmented samples of a step.

        The frames are dealt out in turn, first those of X_l, then those of X_u, so that every
        process gets about as many of each kind.
        """
        augmented = []
        indices = self.frame_indices(step)
        for position in range(self._rank, len(indices), self._processes):
            index = indices[position]
            generator = np.random.default_rng([self._settings.seed, step, position])
            augmented.append(self._augmentation.apply(self._sample(index), self.bank, generator))
        return augmented

    def for_loader(self, loaders: int) -> Self:
        """Return the same batches for one of several loaders: its cache is empty and smaller."""
        own = copy.copy(self)
        vars(own).update(
            _cache={}, _free_cache_bytes=self._settings.cache_bytes // loaders // self._processes
        )
        return own

    def frame_indices(self, step: int) -> list[int]:
        """Return the indices of the frames of a step, in X_l and then in X_u.

        Each pass over X_l or X_u visits every frame once, in a new random order.
        """
        unlabeled_count = self._settings.unlabeled_batch_size if len(self.unlabeled) else 0
        indices = []
        for pool, count in (
            (self.labeled, self._settings.batch_size),
            (self.unlabeled, unlabeled_count),
        ):
            for draw in range(step * count, (step + 1) * count):
                seed = [self._settings.seed, draw // len(pool), int(pool is self.labeled)]
                order = np.random.default_rng(seed).permutation(len(pool))
                indices.append(int(pool[order[draw % len(pool)]]))
        return indices

    def _sample(self, index: int) -> Sample:
        """Return the sample without augmentation, from the cache if it had room for it."""
        if index in self._cache:
            return self._cache[index]
        sample = self._labels[index]
        if sample.points.nbytes <= self._free_cache_bytes:
            self._free_cache_bytes -= sample.points.nbytes
            self._cache[index] = sample
        return sample
