"""Segmenters, one file each: they return the semantic map of a frame's image."""
