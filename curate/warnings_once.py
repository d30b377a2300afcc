"""Warnings that many frames, stages and objects would repeat."""

import logging
from functools import cache

_log = logging.getLogger(__name__)


@cache
def warn_once(message: str) -> None:
    """Log a warning once per process."""
    _log.warning("%s", message)
