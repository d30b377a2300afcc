"""Geometry of boxes and points: overlap, projection into the image, similarity transforms."""
