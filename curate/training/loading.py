"""Batches of a training on its device, prepared ahead by other processes where there are any.

torch's DataLoader is not used: if a worker is killed, it raises an error wherever the main process
is at that moment, even in the middle of a snapshot.
"""

import copy
import multiprocessing
import os
import pickle
from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import fields, is_dataclass, replace
from itertools import islice
from threading import Thread
from typing import Any

import torch

from curate.detectors.base import Student
from curate.errors import CurateError
from curate.training.batches import Batches
from curate.training.settings import TrainingSettings

# Batches that are prepared ahead by each loader: the one in progress, and one that waits.
_AHEAD = 2


def encoder_of(student: Student, settings: TrainingSettings) -> Student:
    """Return the student that encodes: a copy on the CPU if other processes use it."""
    return copy.deepcopy(student) if settings.loaders else student


def load_batches(
    student: Student, batches: Batches, steps: range, settings: TrainingSettings
) -> Iterator[Any]:
    """Yield the batch of each step on the training device.

    A batch depends on its step alone, so the batches are the same with and without loaders.

    Args:
        student: see `encoder_of`.
        batches: the samples of each step.
        steps: the steps, in order.
        settings: settings of the training.

    Raises:
        DataError: if a frame cannot be read.
        CurateError: if a loader is killed.
    """
    if not settings.loaders:
        for step in steps:
            yield student.encode(batches[step], settings.device)
        return
    own = batches.for_loader(settings.loaders)
    pool = ProcessPoolExecutor(
        settings.loaders,
        # A fork would inherit the locks and connections of this process.
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_loader,
        initargs=(student, own),
    )
    waiting = iter(steps)
    first = islice(waiting, _AHEAD * settings.loaders)
    ahead = deque(pool.submit(_load, step) for step in first)
    try:
        while ahead:
            packed = ahead.popleft().result()
            ahead.extend(pool.submit(_load, step) for step in islice(waiting, 1))
            yield to_device(pickle.loads(packed), settings.device)  # noqa: S301 - from a loader
    except BrokenProcessPool:
        raise CurateError(
            "a process that prepares batches was killed, perhaps for lack of memory; rerun, with "
            "fewer train.loaders if it happens again; the training resumes from its last snapshot"
        ) from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


_loader: tuple[Student, Batches] | None = None


def _start_loader(student: Student, batches: Batches) -> None:
    """Prepare this process to load batches; it ends when the training's process is killed."""
    global _loader  # noqa: PLW0603 - the only way from the initializer to the tasks
    torch.set_num_threads(1)
    _loader = student, batches
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _load(step: int) -> bytes:
    """Return the pickled batch of a step; torch would pass it through limited shared memory."""
    if _loader is None:
        raise CurateError("a loader got a step before its batches")
    student, batches = _loader
    return pickle.dumps(student.encode(batches[step], "cpu"))


def to_device(batch: Any, device: str) -> Any:
    """Return a batch with all its tensors on a device.

    Tensors are looked for in dataclasses, mappings and sequences. Copies to a CUDA device are made
    from pinned memory, and the CPU does not wait for them.
    """
    if device == "cpu":
        return batch
    pinned = device.startswith("cuda")

    def moved(value: Any) -> Any:
        if isinstance(value, torch.Tensor):
            return (value.pin_memory() if pinned else value).to(device, non_blocking=pinned)
        if is_dataclass(value) and not isinstance(value, type):
            inner = {each.name: getattr(value, each.name) for each in fields(value) if each.init}
            return replace(value, **moved(inner))
        if isinstance(value, Mapping):
            return {key: moved(each) for key, each in value.items()}
        if isinstance(value, list | tuple):
            inner_values = map(moved, value)
            named = hasattr(value, "_fields")
            return type(value)(*inner_values) if named else type(value)(inner_values)
        return value

    return moved(batch)
