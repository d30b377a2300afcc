"""Any detector's saved answers, in place of the detector: CSV, KITTI, OpenPCDet, mmdetection3d."""

from curate.detectors.recorded.detector import RecordedDetector

__all__ = ["RecordedDetector"]
