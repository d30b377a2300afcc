"""Probabilities of labels: a fit to labels with known truth, and what a policy makes of them."""
