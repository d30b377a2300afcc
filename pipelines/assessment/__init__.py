"""Audits and evaluations against ground truth, and the checks of `curate doctor`."""
