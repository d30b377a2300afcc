"""Messages that many frames, stages and objects would repeat."""

import logging
from functools import cache
from typing import Final

NOTES: Final = "curate.notes"
"""Name of the logger of notes, which the command line prints."""

_log = logging.getLogger(__name__)
_notes = logging.getLogger(NOTES)


@cache
def warn_once(message: str) -> None:
    """Log a warning once per process."""
    _log.warning("%s", message)


@cache
def note_once(message: str) -> None:
    """Log what a user should know, although nothing is wrong, once per process."""
    _notes.info("%s", message)
