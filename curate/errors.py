"""Every error that curate raises on purpose, each with its exit code.

CurateError (1)
├── ConfigError (2)      a setting or an argument is wrong
├── DataError (3)        a file of a data set is missing, damaged or malformed
├── ModelError (4)       a detector or segmenter cannot be used as it is
├── LeakageError (5)     ground truth would reach a place where it must not be
├── WorkspaceError (6)   a workspace, or the input of a stage, is missing
├── DatabaseError (7)    the database is unavailable, damaged, or of another version
├── FramesFailed (8)     the command finished, but some frames failed; each is recorded
├── CellsFailed (9)      the grid finished, but some cells failed; the others are kept
├── TrainerFailed (10)   the user's trainer ended with an error, or without a checkpoint
└── LabelsVanished (11)  all labels, or all of a category, are gone; the former exports are kept

Each message is one line: what is wrong, where (file and line), and what to do.
"""

from collections.abc import Iterator
from contextlib import contextmanager


class CurateError(Exception):
    """Base class of the tree; `exit_code` is the exit status of the command that raised it."""

    exit_code = 1


class ConfigError(CurateError):
    """A setting or an argument is wrong."""

    exit_code = 2


class DataError(CurateError):
    """A file of a data set is missing, damaged or malformed."""

    exit_code = 3


class ModelError(CurateError):
    """A detector or segmenter cannot be used as it is."""

    exit_code = 4


class LeakageError(CurateError):
    """Ground truth would reach a place where it must not be."""

    exit_code = 5


class WorkspaceError(CurateError):
    """A workspace, or the input of a stage, is missing."""

    exit_code = 6


class DatabaseError(CurateError):
    """The database is unavailable, damaged, or of another version."""

    exit_code = 7


class FramesFailed(CurateError):  # noqa: N818 - named after the frames, not after an error
    """The command finished, but some frames failed; each is recorded with its error."""

    exit_code = 8


class CellsFailed(CurateError):  # noqa: N818 - named after the cells, not after an error
    """The grid finished, but some cells failed; the results of the others are kept."""

    exit_code = 9


class ProcessDied(CurateError):  # noqa: N818 - named after the process, not after an error
    """A process of the training was killed; the training can resume from its last snapshot."""


class TrainerFailed(CurateError):  # noqa: N818 - it reports another program's failure
    """The user's trainer ended with an error, or without a checkpoint."""

    exit_code = 10


class LabelsVanished(CurateError):  # noqa: N818 - named after the labels, not after an error
    """All labels, or all weighted labels of a category, are gone; the former exports are kept."""

    exit_code = 11


def one_line(error: BaseException, max_length: int | None = None) -> str:
    """Return the message of another library's error on one line, to quote in an error message.

    Args:
        error: the error; the line is empty if it has no message.
        max_length: number of characters to keep; all if None.
    """
    return " ".join(str(error).split())[:max_length]


def joined_lines(error: BaseException | None) -> str:
    """Return the lines of a database's error message joined by semicolons."""
    return "; ".join(line.strip() for line in str(error).splitlines() if line.strip())


def first_line(error: BaseException) -> str:
    """Return the first line of another library's error message, or the error's type name."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


@contextmanager
def error_prefix(place: str) -> Iterator[None]:
    """Put a place, such as a file, a frame or a setting, in front of the message of an error."""
    try:
        yield
    except CurateError as error:
        raise type(error)(f"{place}: {error}") from error
