"""The benchmark: a resumable grid of methods x labeled ratios x seeds, and its tables."""
