"""Reading of nuScenes' JSON results: one frame at a time if ijson is installed, else whole."""

import codecs
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from curate.errors import DataError, one_line
from curate.files.json_text import read_json

_PEEK_BYTES = 4096


def holds_object(path: Path) -> bool:
    """Return whether a file starts like a JSON object."""
    try:
        with path.open("rb") as file:
            start = file.read(_PEEK_BYTES).removeprefix(codecs.BOM_UTF8)
            return start.lstrip().startswith(b"{")
    except OSError:
        return False


def stream_results(path: Path) -> Iterator[tuple[str, Any]]:
    """Yield key and value of each entry of `results`, in the order of the file.

    Without ijson the whole file is read, which takes six times its size in memory.

    Raises:
        DataError: if it is not JSON, or `results` is missing or not an object.
    """
    try:
        import ijson
    except ImportError:
        yield from _results_of(path, read_json(path)).items()
        return
    found = False
    try:
        with path.open("rb") as file:
            if file.read(len(codecs.BOM_UTF8)) != codecs.BOM_UTF8:
                file.seek(0)
            for key, value in ijson.kvitems(file, "results", use_float=True):
                found = True
                yield key, value
    except (ijson.JSONError, OSError, ValueError) as error:
        read_json(path)  # its message says more
        raise DataError(f"{path}: cannot be read as JSON: {one_line(error, 200)}") from None
    if not found:
        # `results` is empty, missing, or not an object. Read the whole file to report which.
        yield from _results_of(path, read_json(path)).items()


def _results_of(path: Path, content: Any) -> dict[str, Any]:
    if not isinstance(content, dict) or "results" not in content:
        raise DataError(
            f"{path}: contains a {type(content).__name__}, not a list of frames and not nuScenes "
            "results (an object with meta and results)"
        )
    results = content["results"]
    if not isinstance(results, dict):
        raise DataError(
            f"{path}: results is a {type(results).__name__}, not an object of sample tokens"
        )
    return results
