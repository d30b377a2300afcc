"""PointPillar, SECOND and Voxel R-CNN in plain torch, with the checkpoints of OpenPCDet."""

from curate.detectors.openpcdet.detector import OpenPCDetDetector

__all__ = ["OpenPCDetDetector"]
