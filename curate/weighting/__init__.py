"""Policies that compute weights from evidence, one file each."""
