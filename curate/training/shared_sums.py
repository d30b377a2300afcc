"""Sums of tensors over the processes of one machine, through shared memory.

A step sums the statistics of every batch normalisation twice, and the gradients. Over sockets each
sum takes a third of a millisecond of every process, and twice as long to wait for; through shared
memory it takes some 40 microseconds.
"""

import os
from multiprocessing.context import BaseContext
from typing import Any

import numpy as np
import torch
from torch import Tensor

# Numbers that are summed at once; longer tensors are summed in parts.
_CAPACITY = 1 << 18


class SharedSums:
    """Memory and pipes for the sums of some processes; it is passed on to their start.

    Every process writes its numbers into its row, signals every other one, waits for their signals,
    and adds up the rows, in the same order everywhere. Two halves of the memory take turns: a
    process that writes into one has read the others' signals for the other half, so all of them
    have finished the sum before.

    A signal is a byte with the number of the process, in the pipe of the process that waits for it.
    A fast process may signal its next sum before a slow one signals this sum, so signals are
    counted by process. Semaphores would outlive a killed caller; pipes and this memory do not.

    Args:
        context: starts the processes.
        processes: number of processes, at most 256.
        timeout_s: how long to wait for another process.
    """

    def __init__(self, context: BaseContext, processes: int, timeout_s: float) -> None:
        self._shape, self._timeout_s = (2, processes, _CAPACITY), timeout_s
        self._memory: Any = context.RawArray("d", 2 * processes * _CAPACITY)
        self._pipes = [context.Pipe(duplex=False) for _ in range(processes)]
        self._calls = 0
        # In the process that uses it: the memory, and the signals to come by process.
        self._rows: np.ndarray | None = None
        self._signals: list[int] = []

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
            self._signals = [0] * self._shape[1]
        rows = self._rows[self._calls % 2, :, : len(values)]
        self._calls += 1
        rows[rank] = values
        for other, (_, writer) in enumerate(self._pipes):
            if other != rank:
                os.write(writer.fileno(), bytes([rank]))
        self._signals[rank] += 1
        self._wait(rank)
        total: np.ndarray = rows.sum(axis=0)
        return total

    def _wait(self, rank: int) -> None:
        """Wait for a signal of every process, and take it."""
        inbox, _ = self._pipes[rank]
        while not all(self._signals):
            if not inbox.poll(self._timeout_s):
                late = self._signals.index(0)
                raise RuntimeError(f"training process {late + 1} does not answer")
            for sender in os.read(inbox.fileno(), 1 << 12):
                self._signals[sender] += 1
        self._signals = [count - 1 for count in self._signals]
