"""Sums of tensors over the processes of one machine, through shared memory.

A step sums the statistics of every batch normalisation twice, and the gradients. Over sockets each
sum takes a third of a millisecond of every process, and twice as long to wait for; through shared
memory it takes some 20 microseconds.
"""

from multiprocessing.context import BaseContext
from typing import Any

import numpy as np
import torch
from torch import Tensor

# Numbers that are summed at once; longer tensors are summed in parts.
_CAPACITY = 1 << 18


class SharedSums:
    """Memory and semaphores for the sums of some processes; it is passed on to their start.

    Every process writes its numbers into its row, signals every other one, waits for their signals,
    and adds up the rows, in the same order everywhere. Two halves of the memory take turns: a
    process that writes into one has read the others' signals for the other half, so all of them
    have finished the sum before.

    Args:
        context: starts the processes.
        processes: number of processes.
        timeout_s: how long to wait for another process.
    """

    def __init__(self, context: BaseContext, processes: int, timeout_s: float) -> None:
        self._shape, self._timeout_s = (2, processes, _CAPACITY), timeout_s
        self._memory: Any = context.RawArray("d", 2 * processes * _CAPACITY)
        # The semaphore in row i, column j signals process j that process i has written.
        ranks = range(processes)
        self._written = [[context.Semaphore(0) for _ in ranks] for _ in ranks]
        self._calls = 0
        self._rows: np.ndarray | None = None  # in the process that uses it

    def sum(self, rank: int, values: Tensor) -> Tensor:
        """Return the sum of a tensor over the processes, added up in double precision.

        Raises:
            RuntimeError: if another process does not take part in time.
        """
        flat = values.detach().numpy().reshape(-1)
        total = np.empty_like(flat)
        for start in range(0, len(flat), _CAPACITY):
            part = slice(start, start + _CAPACITY)
            total[part] = self._sum_part(rank, flat[part])
        return torch.from_numpy(total).view(values.shape)

    def _sum_part(self, rank: int, values: np.ndarray) -> np.ndarray:
        if self._rows is None:
            self._rows = np.frombuffer(self._memory, dtype=np.float64).reshape(self._shape)
        rows = self._rows[self._calls % 2, :, : len(values)]
        self._calls += 1
        rows[rank] = values
        others = [other for other in range(self._shape[1]) if other != rank]
        for other in others:
            self._written[rank][other].release()
        for other in others:
            if not self._written[other][rank].acquire(timeout=self._timeout_s):
                raise RuntimeError(f"training process {other + 1} does not answer")
        total: np.ndarray = rows.sum(axis=0)
        return total
