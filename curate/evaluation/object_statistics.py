"""How hard the objects of a data set are: by difficulty, occlusion, truncation and distance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from curate.datasets.kitti.labels import KittiObjects
from curate.evaluation.kitti_rules import COUNTED, DIFFICULTIES, MAX_TRUNCATIONS, label_states

QUANTILES = (0.1, 0.5, 0.9)


@dataclass(frozen=True)
class ObjectStatistics:
    """The objects of one category.

    Attributes:
        objects: all that are labelled.
        per_frame: their number per frame.
        counted: number per frame that counts at each difficulty of `DIFFICULTIES`; those of one
            are among those of the next.
        occluded: share with occlusion level 1 or more.
        mostly_occluded: share with level 2 or more.
        truncated: share of which too much lies outside the image for KITTI to call them easy.
        distances: quantiles of the distance from the camera in metres, see `QUANTILES`.
    """

    objects: int
    per_frame: float
    counted: tuple[float, ...]
    occluded: float
    mostly_occluded: float
    truncated: float
    distances: tuple[float, ...]


def object_statistics(
    frames: Sequence[KittiObjects], categories: Sequence[str]
) -> Mapping[str, ObjectStatistics]:
    """The statistics of each category; shares and distances are NaN where there is no object."""
    return {category: _of_category(frames, category) for category in categories}


def _of_category(frames: Sequence[KittiObjects], category: str) -> ObjectStatistics:
    own = [frame.select(frame.categories == category) for frame in frames]
    empty = KittiObjects.empty()
    occluded = np.concatenate([each.occluded for each in (empty, *own)])
    truncated = np.concatenate([each.truncated for each in (empty, *own)])
    locations = np.concatenate([each.locations for each in (empty, *own)])
    distances = np.hypot(locations[:, 0], locations[:, 2])
    count = len(occluded)
    frame_count = max(len(frames), 1)
    counted = [
        sum(int((label_states(each, category, level) == COUNTED).sum()) for each in own)
        for level in range(len(DIFFICULTIES))
    ]
    return ObjectStatistics(
        objects=count,
        per_frame=count / frame_count,
        counted=tuple(number / frame_count for number in counted),
        occluded=_share(occluded >= 1),
        mostly_occluded=_share(occluded >= 2),
        truncated=_share(truncated > MAX_TRUNCATIONS[0]),
        distances=tuple(
            float(np.quantile(distances, share)) if count else np.nan for share in QUANTILES
        ),
    )


def _share(chosen: np.ndarray) -> float:
    return float(chosen.mean()) if len(chosen) else np.nan
