"""The type of path arguments of public functions."""

import os

StrPath = str | os.PathLike[str]
"""A path as `str` or as `pathlib.Path`."""
