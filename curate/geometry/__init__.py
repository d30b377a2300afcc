"""Boxes, their overlap, projection into the image, and the similarity transform."""
