"""File formats of point clouds and images, and checks of their paths."""
