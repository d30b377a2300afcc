"""Detector that reads stored predictions: tables, and result formats of other projects."""

from curate.detectors.recorded.detector import RecordedDetector

__all__ = ["RecordedDetector"]
