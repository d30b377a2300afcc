"""Reading of JSON files: whole, or one frame at a time if ijson is installed."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from curate.errors import DataError, one_line

_PEEK_BYTES = 4096


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        DataError: if it is missing or not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except (OSError, RecursionError, ValueError) as error:
        raise _damaged(path, error) from None


def holds_object(path: Path) -> bool:
    """Return whether a file starts like a JSON object."""
    try:
        with path.open("rb") as file:
            return file.read(_PEEK_BYTES).lstrip().startswith(b"{")
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
            for key, value in ijson.kvitems(file, "results", use_float=True):
                found = True
                yield key, value
    except (ijson.JSONError, OSError, ValueError) as error:
        raise _damaged(path, error) from None
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


def _damaged(path: Path, error: Exception) -> DataError:
    return DataError(f"{path}: cannot be read as JSON: {one_line(error, 200)}")
