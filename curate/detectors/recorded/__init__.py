"""Any detector's saved answers, in place of the detector: tables, and other projects' formats."""

from curate.detectors.recorded.detector import RecordedDetector

__all__ = ["RecordedDetector"]
