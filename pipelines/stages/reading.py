"""Reading frames in threads, before a model on a GPU needs them."""

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor

from curate.frames import Frame
from pipelines.engine.executors.machine import usable_cores

_MOST_THREADS = 8


class FrameReader:
    """Reads frames by name; those that were announced are read by threads in the meantime.

    Args:
        read: reads a frame; called in several threads.
    """

    def __init__(self, read: Callable[[str], Frame]) -> None:
        self._read = read
        self._threads = ThreadPoolExecutor(min(_MOST_THREADS, usable_cores()))
        self._ahead: dict[str, Future[Frame]] = {}

    def announce(self, names: Iterable[str]) -> None:
        """Begin to read frames that will be needed next."""
        for name in names:
            self._ahead[name] = self._threads.submit(self._read, name)

    def __call__(self, name: str) -> Frame:
        """Return a frame; an error in reading it is raised here."""
        ahead = self._ahead.pop(name, None)
        return self._read(name) if ahead is None else ahead.result()
