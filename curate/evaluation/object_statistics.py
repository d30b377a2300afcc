"""Statistics of the labeled objects of a data set: difficulty, occlusion, truncation, distance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from curate.datasets.kitti.labels import KittiObjects
from curate.evaluation.difficulties import KITTI
from curate.evaluation.kitti_rules import MAX_TRUNCATIONS

QUANTILES = (0.1, 0.5, 0.9)


@dataclass(frozen=True)
class ObjectStatistics:
    """Statistics of the objects of one category.

    Attributes:
        objects: number of labeled objects.
        per_frame: objects per frame.
        counted: objects per frame that count at each of KITTI's levels; each level includes
            the easier ones.
        occluded: share with occlusion level 1 or more.
        mostly_occluded: share with occlusion level 2 or more.
        truncated: share that is truncated more than KITTI allows for "easy".
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
    """Return the statistics of each category; shares and distances are NaN without objects."""
    return {category: _of_category(frames, category) for category in categories}


def _of_category(frames: Sequence[KittiObjects], category: str) -> ObjectStatistics:
    selected = [frame.select(frame.categories == category) for frame in frames]
    empty = KittiObjects.empty()
    occluded = np.concatenate([each.occluded for each in (empty, *selected)])
    truncated = np.concatenate([each.truncated for each in (empty, *selected)])
    locations = np.concatenate([each.locations for each in (empty, *selected)])
    distances = np.hypot(locations[:, 0], locations[:, 2])
    count = len(occluded)
    frame_count = max(len(frames), 1)
    counted = [
        sum(int((KITTI.object_reasons(each, level, None) == 0).sum()) for each in selected)
        for level in range(len(KITTI.levels))
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


def _share(flags: np.ndarray) -> float:
    return float(flags.mean()) if len(flags) else np.nan
