"""Estimate the time of a job: its units of work times the rates of finished jobs."""

from collections.abc import Iterable, Mapping
from statistics import median
from types import MappingProxyType

from pipelines.bench.grid import EVALUATE, TRAIN
from pipelines.bench.results import JobResult

# Seconds per optimiser step of two frames, and per frame, for the small detector on one thread of a
# laptop: the estimate until the first jobs of the bench are finished.
FIRST_GUESS: Mapping[str, float] = MappingProxyType({
    TRAIN: 0.16,
    "segment": 0.05,
    "predict": 0.03,
    "repredict": 0.03,
    "points": 0.005,
    "semantic": 0.005,
    EVALUATE: 0.025,
})  # fmt: skip
# Time to start a process, load its libraries, solve, export and compute AP.
OVERHEAD_S = 15.0


class Costs:
    """Estimates from measured rates; they improve with every finished job."""

    def __init__(self, finished: Iterable[JobResult] = ()) -> None:
        self._measured: dict[str, tuple[int, float]] = {}
        self._overheads: list[float] = []
        for result in finished:
            self.learn(result)

    @property
    def measured(self) -> bool:
        """Whether the rate of training is measured, not guessed."""
        return TRAIN in self._measured

    def learn(self, result: JobResult) -> None:
        """Update the rates with the times of a finished job."""
        for kind, (units, seconds) in result.timings.items():
            before = self._measured.get(kind, (0, 0.0))
            if units:
                self._measured[kind] = (before[0] + units, before[1] + seconds)
        measured = sum(seconds for _, seconds in result.timings.values())
        self._overheads.append(max(result.seconds - measured, 0.0))

    def rate(self, kind: str) -> float:
        """Return the seconds per unit of a kind of work."""
        units, seconds = self._measured.get(kind, (0, 0.0))
        return seconds / units if units else FIRST_GUESS[kind]

    def seconds(self, work: Mapping[str, int]) -> float:
        """Return the expected time of a job with this work."""
        # The median, because the first job also compiles the kernels that later jobs load.
        overhead = median(self._overheads) if self._overheads else OVERHEAD_S
        return overhead + sum(units * self.rate(kind) for kind, units in work.items())
