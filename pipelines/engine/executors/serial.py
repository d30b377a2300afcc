"""The default executor: this process, one frame after the other."""

from collections.abc import Iterable, Iterator

from pipelines.engine.executors.base import Job, JobFunction, Outcome, attempt, open_function


class SerialExecutor:
    """Works on frames in their order."""

    def map(self, function: JobFunction, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """One outcome per job, in order.

        Raises:
            CurateError: if the models cannot be loaded.
        """
        open_function(function)
        for job in jobs:
            yield attempt(function, job)

    def close(self) -> None:
        """Nothing to end."""
