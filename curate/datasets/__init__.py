"""Readers of LiDAR-camera data sets, one file each."""
