"""The executor that processes one frame after the other in this process."""

from collections.abc import Iterable, Iterator

from pipelines.engine.executors.base import (
    Job,
    JobFunction,
    Outcome,
    attempt,
    open_function,
    outcomes_of,
    reading_ahead,
)


class SerialExecutor:
    """Processes frames one by one, in order."""

    def map(self, function: JobFunction, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """Yield one outcome per frame or sequence, in order.

        Raises:
            CurateError: if the models cannot be loaded.
        """
        open_function(function)
        for job in reading_ahead(function, jobs):
            yield from outcomes_of(job, attempt(function, job))

    def close(self) -> None:
        """Do nothing: there are no workers."""
