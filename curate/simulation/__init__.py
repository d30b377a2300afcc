"""Simulation of a LiDAR-camera data set in KITTI's format by ray casting with Open3D."""

from curate.simulation.scene import SEMANTIC_CLASSES
from curate.simulation.writer import SEMANTIC_FOLDER, simulate

__all__ = ["SEMANTIC_CLASSES", "SEMANTIC_FOLDER", "simulate"]
