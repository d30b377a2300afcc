"""Reader of nuScenes: the key frames of the LiDAR and one camera, from nuScenes' tables."""

from curate.datasets.nuscenes.dataset import NuScenesDataset

__all__ = ["NuScenesDataset"]
