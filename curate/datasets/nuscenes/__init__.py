"""Reader of nuScenes: the key frames of the LiDAR and of cameras, from nuScenes' tables."""

from curate.datasets.nuscenes.dataset import NuScenesDataset

__all__ = ["NuScenesDataset"]
