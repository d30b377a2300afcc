"""Detector that runs a command of the user on copies of the frames, and reads its results."""

from curate.detectors.command.detector import CommandDetector

__all__ = ["CommandDetector"]
