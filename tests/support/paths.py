"""Folders that tests need whatever their own place."""

from pathlib import Path

TESTS = Path(__file__).parents[1]
ROOT = TESTS.parent
