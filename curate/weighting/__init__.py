"""Policies that turn evidence into weights, one file each."""
