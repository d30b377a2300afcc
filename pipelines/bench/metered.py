"""A job's progress as its parent process hears of it: a line of JSON now and then."""

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TextIO

from pipelines.bench.grid import EVALUATE, TRAIN
from pipelines.engine.progress import Advance
from pipelines.registry import PRIORS
from pipelines.round import round_graph

TELL_EVERY_S = 0.5


class Metered:
    """Counts units of work by kind, measures what they take, and tells both.

    Args:
        stream: where each line is {"kind": KIND, "units": HOW_MANY_MORE}.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        graph = round_graph(tuple(PRIORS.classes))
        self._kinds = {EVALUATE, *(stage.name for stage in graph.frames_stages)}
        self._measured: dict[str, tuple[int, float]] = {}

    @property
    def timings(self) -> Mapping[str, tuple[int, float]]:
        """Units and seconds by kind; what a track starts with, models to load, is left out."""
        return self._measured

    @contextmanager
    def track(self, what: str, total: int) -> Iterator[Advance]:  # noqa: ARG002
        """Yield a function that counts; a training's name is that of its checkpoint."""
        kind = what if what in self._kinds else TRAIN
        begun: float | None = None
        told, units, untold = time.monotonic(), 0, 0

        def advance(step: int, _note: str) -> None:
            nonlocal begun, told, units, untold
            now = time.monotonic()
            # The first units may be those of an earlier run, and wait for what is loaded.
            if begun is None:
                begun = now if step else None
            else:
                units += step
            untold += step
            if now - told >= TELL_EVERY_S:
                self._report(kind, untold)
                told, untold = now, 0

        yield advance
        self._report(kind, untold)
        if begun is not None:
            before = self._measured.get(kind, (0, 0.0))
            self._measured[kind] = (before[0] + units, before[1] + time.monotonic() - begun)

    def _report(self, kind: str, units: int) -> None:
        if units:
            self._stream.write(json.dumps({"kind": kind, "units": units}) + "\n")
            self._stream.flush()
