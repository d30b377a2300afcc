"""Anchor-free, center-based pillars: the trainable detector."""

from curate.detectors.pillars.detector import PillarDetector

__all__ = ["PillarDetector"]
