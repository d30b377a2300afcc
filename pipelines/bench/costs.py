"""What a job will cost: its work times the rates that finished jobs were measured at."""

from collections.abc import Iterable, Mapping
from statistics import median
from types import MappingProxyType

from pipelines.bench.grid import EVALUATE, TRAIN
from pipelines.bench.results import JobResult

# Seconds per optimiser step of two frames, and per frame, of the small detector on one thread of a
# laptop: a first guess, until the bench has measured its own.
FIRST_GUESS: Mapping[str, float] = MappingProxyType({
    TRAIN: 0.16,
    "predict": 0.03,
    "repredict": 0.03,
    "points": 0.005,
    "semantic": 0.055,
    EVALUATE: 0.025,
})  # fmt: skip
# Starting a process, loading its libraries, solving, exporting, computing AP.
OVERHEAD_S = 15.0


class Costs:
    """Rates, better with every finished job."""

    def __init__(self, finished: Iterable[JobResult] = ()) -> None:
        self._measured: dict[str, tuple[int, float]] = {}
        self._overheads: list[float] = []
        for result in finished:
            self.learn(result)

    @property
    def measured(self) -> bool:
        """Whether the rate of training has been measured."""
        return TRAIN in self._measured

    def learn(self, result: JobResult) -> None:
        """Take the times of a finished job into account."""
        for kind, (units, seconds) in result.timings.items():
            before = self._measured.get(kind, (0, 0.0))
            if units:
                self._measured[kind] = (before[0] + units, before[1] + seconds)
        known = sum(seconds for _, seconds in result.timings.values())
        self._overheads.append(max(result.seconds - known, 0.0))

    def rate(self, kind: str) -> float:
        """Seconds per unit of a kind of work."""
        units, seconds = self._measured.get(kind, (0, 0.0))
        return seconds / units if units else FIRST_GUESS[kind]

    def seconds(self, work: Mapping[str, int]) -> float:
        """What a job is expected to take."""
        # The first job compiles kernels that later ones find on disk: no mean.
        overhead = median(self._overheads) if self._overheads else OVERHEAD_S
        return overhead + sum(units * self.rate(kind) for kind, units in work.items())
