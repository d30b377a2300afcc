"""nuScenes: key frames of its LiDAR and one camera, read from its tables."""

from curate.datasets.nuscenes.dataset import NuScenesDataset

__all__ = ["NuScenesDataset"]
