"""Stored labels and their evidence, read back from the database."""
