"""Report the progress of a job to its parent process as lines of JSON."""

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TextIO

from pipelines.bench.grid import EVALUATE, TRAIN
from pipelines.engine.progress import Advance
from pipelines.registry import PRIORS
from pipelines.round import round_graph

REPORT_EVERY_S = 0.5


class Metered:
    """Count and time units of work by kind, and report the counts.

    Args:
        stream: receives lines of the form {"kind": KIND, "units": NUMBER_OF_FURTHER_UNITS}.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        graph = round_graph(tuple(PRIORS.classes), fused=True)
        self._kinds = {EVALUATE, *(stage.name for stage in graph.frames_stages)}
        self._measured: dict[str, tuple[int, float]] = {}

    @property
    def timings(self) -> Mapping[str, tuple[int, float]]:
        """Units and seconds by kind, without the time to load models at the start."""
        return self._measured

    @contextmanager
    def track(self, what: str, total: int) -> Iterator[Advance]:  # noqa: ARG002
        """Yield a function that counts units of work."""
        # A training is tracked under the name of its checkpoint.
        kind = what if what in self._kinds else TRAIN
        started: float | None = None
        last_report, units, unreported = time.monotonic(), 0, 0

        def advance(step: int, _note: str) -> None:
            nonlocal started, last_report, units, unreported
            now = time.monotonic()
            # The first units are not timed: they may be of an earlier run, or include loading.
            if started is None:
                started = now if step else None
            else:
                units += step
            unreported += step
            if now - last_report >= REPORT_EVERY_S:
                self._report(kind, unreported)
                last_report, unreported = now, 0

        yield advance
        self._report(kind, unreported)
        if started is not None:
            before = self._measured.get(kind, (0, 0.0))
            self._measured[kind] = (before[0] + units, before[1] + time.monotonic() - started)

    def _report(self, kind: str, units: int) -> None:
        if units:
            self._stream.write(json.dumps({"kind": kind, "units": units}) + "\n")
            self._stream.flush()
