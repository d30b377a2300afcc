"""Executors map a function over frames: one file each, the same rows from all of them."""
