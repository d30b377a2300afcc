"""What a public function takes where it needs a path."""

import os

StrPath = str | os.PathLike[str]
"""A path as text or as `pathlib.Path`."""
