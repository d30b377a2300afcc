"""JSON files of records: whole, or the results of one frame at a time where ijson is installed."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from curate.errors import DataError, one_line

_PEEKED = 4096


def read_json(path: Path) -> Any:
    """What a file holds.

    Raises:
        DataError: if it is missing or no JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except (OSError, RecursionError, ValueError) as error:
        raise _damaged(path, error) from None


def holds_object(path: Path) -> bool:
    """Return whether a file begins as a JSON object does."""
    try:
        with path.open("rb") as file:
            return file.read(_PEEKED).lstrip().startswith(b"{")
    except OSError:
        return False


def stream_results(path: Path) -> Iterator[tuple[str, Any]]:
    """Key and value of each entry of `results`, in their order in the file.

    Without ijson the file is read whole, which takes six times its size.

    Raises:
        DataError: if it is no JSON, or `results` is missing or no object.
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
        # Nothing, or something else than an object: only what is around it tells which.
        yield from _results_of(path, read_json(path)).items()


def _results_of(path: Path, held: Any) -> dict[str, Any]:
    if not isinstance(held, dict) or "results" not in held:
        raise DataError(
            f"{path}: holds a {type(held).__name__}, not a list of frames, and no nuScenes "
            "results: an object with meta and results"
        )
    results = held["results"]
    if not isinstance(results, dict):
        raise DataError(
            f"{path}: results is no object of sample tokens but a {type(results).__name__}"
        )
    return results


def _damaged(path: Path, error: Exception) -> DataError:
    return DataError(f"{path}: cannot be read as JSON: {one_line(error, 200)}")
