"""KITTI: the object data set, its label text, and the raw recordings."""
