"""Reading of whole files."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from curate.errors import DataError


def read_bytes(path: Path, kind: str) -> bytes:
    """Return the content of a file; `kind` is e.g. "point", for error messages.

    Raises:
        DataError: if the file is missing or cannot be read.
    """
    with open_unbuffered(path, kind) as file:
        return file.read()


@contextmanager
def open_unbuffered(path: Path, kind: str) -> Iterator[io.FileIO]:
    """Open a file for one large read, which needs no buffer.

    Raises:
        DataError: if the file is missing or cannot be read.
    """
    try:
        with path.open("rb", buffering=0) as file:
            yield file
    except FileNotFoundError:
        raise DataError(f"{path}: no such {kind} file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
