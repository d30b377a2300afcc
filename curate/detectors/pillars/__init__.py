"""Trainable anchor-free, center-based pillar detector."""

from curate.detectors.pillars.detector import PillarDetector

__all__ = ["PillarDetector"]
