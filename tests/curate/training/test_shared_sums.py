"""Sums through shared memory: correct at any size, for any number of processes."""

import copy
import multiprocessing
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from curate.training import shared_sums
from curate.training.shared_sums import SharedSums

CONTEXT = multiprocessing.get_context("spawn")


@pytest.mark.parametrize("processes", [1, 2, 5])
def test_every_process_gets_the_same_sum(processes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds of sums of different lengths, types and shapes, longer than the memory too."""
    monkeypatch.setattr(shared_sums, "_CAPACITY", 16)
    sums = SharedSums(CONTEXT, processes, 60.0)
    generator = np.random.default_rng(processes)
    sizes = generator.integers(0, 50, 200)
    types = (torch.float32, torch.float64, torch.int64)
    given = [
        [
            torch.from_numpy(generator.normal(size=n) * 100).to(types[k % 3])
            for _ in range(processes)
        ]
        for k, n in enumerate(sizes)
    ]

    def work(rank: int) -> list[torch.Tensor]:
        own = copy.copy(sums)  # as a process has it
        return [own.sum(rank, tensors[rank]) for tensors in given]

    with ThreadPoolExecutor(processes) as pool:
        found = list(pool.map(work, range(processes)))
    for k, tensors in enumerate(given):
        expected = torch.stack([each.double() for each in tensors]).sum(dim=0).to(types[k % 3])
        for of_rank in found:
            torch.testing.assert_close(of_rank[k], expected)
            assert torch.equal(of_rank[k], found[0][k])


def test_a_process_that_does_not_answer_is_reported() -> None:
    with pytest.raises(RuntimeError, match="training process 2 does not answer"):
        SharedSums(CONTEXT, 2, 0.01).sum(0, torch.ones(()))
