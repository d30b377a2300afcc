"""Reading frames in threads, before a model on a GPU needs them."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from curate.frames import Frame
from pipelines.engine.executors.base import FrameJob
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


class ReadsAhead:
    """The part of a stage's function that has a model which may run on a GPU, see `DeviceFunction`.

    Attributes:
        exclusive: whether the model runs on a device that workers should not share.
        read: reads the frames.
    """

    exclusive: bool
    read: FrameReader

    @property
    def workers(self) -> int | None:
        """How many workers run the model at the same time; None for all of them."""
        return 1 if self.exclusive else None

    def prefetch(self, jobs: Sequence[FrameJob]) -> None:
        """Begin to read the frames of the next call."""
        self.read.announce(job.frame for job in jobs)
