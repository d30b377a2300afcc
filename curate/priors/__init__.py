"""Priors: independent evidence for a label, one file each."""
