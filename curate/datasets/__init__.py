"""Readers of LiDAR-camera data sets, one file or folder each."""
