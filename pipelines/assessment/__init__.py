"""Audits, evaluations and checks against known ground truth."""
