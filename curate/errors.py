"""Every error that curate raises on purpose, each with its exit code.

CurateError (1)
├── ConfigError (2)      a setting or an argument is wrong
├── DataError (3)        a file of a data set is missing, damaged or malformed
├── ModelError (4)       a detector or segmenter cannot be used as it is
├── LeakageError (5)     ground truth would reach a place where it must not be
├── WorkspaceError (6)   a workspace or a stage's input is not there
├── DatabaseError (7)    the database refuses, is damaged, or is of another version
├── FramesFailed (8)     the command ended, but some frames failed; they are recorded
├── CellsFailed (9)      the grid ended, but some of its cells failed; the others are kept
└── TrainerFailed (10)   the user's trainer ended with an error, or without a checkpoint

Each message is one line: what is wrong, in which file and where, what to do.
"""


class CurateError(Exception):
    """Root of the tree; `exit_code` is the exit status of the command that raised it."""

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
    """A workspace, or the input of a stage, is not there."""

    exit_code = 6


class DatabaseError(CurateError):
    """The database refuses, is damaged, or is of another version."""

    exit_code = 7


class FramesFailed(CurateError):  # noqa: N818 - it reports frames, it is not itself a fault
    """The command ended, but some frames failed; each is recorded with its error."""

    exit_code = 8


class CellsFailed(CurateError):  # noqa: N818 - it reports cells, it is not itself a fault
    """The grid ended, but some of its cells failed; the others are kept."""

    exit_code = 9


class TrainerFailed(CurateError):  # noqa: N818 - it reports another program's failure
    """The user's trainer ended with an error, or without a checkpoint."""

    exit_code = 10


def one_line(error: BaseException, longest: int | None = None) -> str:
    """What another library's error says, as one line for a message of ours.

    Args:
        error: may say nothing; then the line is empty.
        longest: letters to keep; all of them without.
    """
    return " ".join(str(error).split())[:longest]


def joined_lines(error: BaseException | None) -> str:
    """What a database's error says on several lines, as one: parted by semicolons."""
    return "; ".join(line.strip() for line in str(error).splitlines() if line.strip())


def first_line(error: BaseException) -> str:
    """What another library's error says first, for one whose message is a page."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
