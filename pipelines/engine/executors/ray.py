"""Several machines: a pool of Ray actors, each of which holds its own model.

The runner stays the only writer; what travels is a frame's name with what is known of it, and its
rows. Every node needs the same curate, and the data set at the same path.
"""

import os
import pickle
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from curate.errors import ConfigError, CurateError, one_line
from pipelines.engine.executors.base import (
    IN_HAND,
    Job,
    JobFunction,
    JobQueue,
    Outcome,
    RayWorker,
)

PULSE_S = 5.0
# Frames and rows are small; by default Ray takes a third of the memory of a machine.
OBJECT_STORE_BYTES = 256 * 1024**2


class RayExecutor:
    """Works on frames in `workers` actors, which live until `close`.

    Args:
        workers: how many actors; those for which the cluster has no room wait until it has.
        address: of a running cluster, e.g. "auto" or "10.0.0.1:6379"; None joins the cluster that
            RAY_ADDRESS names, or starts one on this machine.
        num_cpus: that an actor takes.
        num_gpus: that an actor takes; a fraction where several share one.
        start_timeout_s: how long the cluster may take to place the first actor.

    Raises:
        ConfigError: Ray is not installed.
        CurateError: the cluster cannot be joined or started.
    """

    def __init__(
        self,
        workers: int = 1,
        *,
        address: str | None = None,
        num_cpus: float = 1.0,
        num_gpus: float = 0.0,
        start_timeout_s: float = 120.0,
    ) -> None:
        self.workers = workers
        self.start_timeout_s = start_timeout_s
        self._ray = _import_ray()
        self._needs = {"num_cpus": num_cpus, "num_gpus": num_gpus}
        self._own = not self._ray.is_initialized()
        if self._own:
            _join(self._ray, address, workers)
        # A dead actor is replaced by another one, so that it is known which frame it had begun.
        options = {**self._needs, "max_restarts": 0, "scheduling_strategy": "SPREAD"}
        self._holder = self._ray.remote(**options)(ActorHolder)
        self._crew: list[_Actor] = []

    def map(self, function: JobFunction, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """One outcome per job, as they end.

        Raises:
            CurateError: if the models cannot be loaded, actors die while they load them, or the
                cluster has no room for a single actor.
        """
        queue = JobQueue(jobs, self.workers)
        packed = pickle.dumps(function)
        placed_at = time.monotonic()
        try:
            while self._dispatch(packed, queue):
                heads = {actor.head(): actor for actor in self._crew if actor.answers}
                ready, _ = self._ray.wait(list(heads), num_returns=1, timeout=PULSE_S)
                for ref in ready:
                    yield from self._collect(heads[ref], queue)
                if any(actor.placed for actor in self._crew):
                    placed_at = time.monotonic()
                self._check_placement_timeout(placed_at)
        finally:
            for actor in [actor for actor in self._crew if actor.answers]:
                self._dismiss(actor)

    def close(self) -> None:
        """End the actors, and the cluster if it was started here."""
        for actor in list(self._crew):
            self._dismiss(actor)
        if self._own:
            self._ray.shutdown()

    def _dispatch(self, packed: bytes, queue: JobQueue) -> bool:
        """Return every actor that has loaded its models work; False where all is done."""
        while (job := queue.take()) is not None:
            while len(self._crew) < self.workers:
                self._crew.append(_Actor(self._holder.remote(sys.path)))
            for actor in self._crew:
                actor.open(packed)
            able = [actor for actor in self._crew if actor.opened and len(actor.jobs) < IN_HAND]
            if not able:
                queue.return_jobs([job])
                return True
            min(able, key=lambda actor: len(actor.jobs)).send(job)
        return any(actor.jobs for actor in self._crew)

    def _collect(self, actor: "_Actor", queue: JobQueue) -> Iterator[Outcome]:
        """Yield the oldest answer of an actor; what it leaves behind if it is dead."""
        try:
            answer = self._ray.get(actor.head())
        except self._ray.exceptions.RayTaskError as error:
            raise CurateError(f"a Ray actor failed: {_reason(error)}") from error
        except self._ray.exceptions.RayError as error:
            jobs, opened = list(actor.jobs), actor.opened
            self._dismiss(actor)
            yield from queue.record_crash(jobs, _reason(error), opened=opened)
            return
        if isinstance(answer, CurateError):
            raise answer
        actor.answers.popleft()
        if actor.opened:
            yield Outcome(actor.jobs.popleft(), *answer)
        elif actor.placed:
            actor.opened = True
            queue.opened()
        else:
            actor.placed = True

    def _dismiss(self, actor: "_Actor") -> None:
        self._crew.remove(actor)
        self._ray.kill(actor.handle)

    def _check_placement_timeout(self, placed_at: float) -> None:
        if time.monotonic() - placed_at > self.start_timeout_s:
            offered = self._ray.cluster_resources()
            raise CurateError(
                f"the Ray cluster has placed no actor in {self.start_timeout_s:.0f} s; each needs "
                f"{self._needs}, all nodes together offer {offered.get('CPU', 0):g} CPUs and "
                f"{offered.get('GPU', 0):g} GPUs: set run.executor_options.ray in curate.toml"
            )


class ActorHolder(RayWorker):
    """What runs in an actor."""

    def __init__(self, search_path: Sequence[str]) -> None:
        super().__init__()
        # A detector that the driver finds beside itself must be found on another node as well.
        sys.path += [path for path in search_path if path not in sys.path]

    def place(self) -> None:
        """Answers once the actor has found its place."""


class _Actor:
    """An actor, and what it has been asked in the order in which it will answer."""

    def __init__(self, handle: Any) -> None:
        self.handle = handle
        self.jobs: deque[Job] = deque()
        self.answers: deque[Any] = deque([handle.place.remote()])
        self.placed = False
        self.opened = False
        self._packed = b""

    def head(self) -> Any:
        """Return the oldest answer that has not been read."""
        return self.answers[0]

    def open(self, packed: bytes) -> None:
        """Has it load its models, unless it holds them."""
        if packed != self._packed:
            self._packed, self.opened = packed, False
            self.answers.append(self.handle.open.remote(packed))

    def send(self, job: Job) -> None:
        """Hand a job over."""
        self.jobs.append(job)
        self.answers.append(self.handle.work.remote(job))


def _import_ray() -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise ConfigError(
            "executor 'ray': Ray is not installed; pip install 'curate-pseudo-labels[ray]'"
        ) from error
    return ray


def _join(ray: Any, address: str | None, workers: int) -> None:
    """Join a cluster, or starts one with a CPU per worker at least."""
    joins = address or os.environ.get("RAY_ADDRESS")
    where: dict[str, Any] = (
        {"address": joins}
        if joins
        else {
            "address": "local",  # not the one that somebody else has started on this machine
            "num_cpus": max(workers, os.cpu_count() or 1),
            "object_store_memory": OBJECT_STORE_BYTES,
            "include_dashboard": False,
        }
    )
    try:
        # Before an actor's class is looked up there; PYTHONPATH may hold other packages so named.
        first = {"worker_process_setup_hook": "curate_command.claim_packages"}
        ray.init(**where, runtime_env=first, logging_level="ERROR", log_to_driver=False)
    except Exception as error:  # Ray raises many kinds, none of which says more than its words
        done = f"joined at {joins}" if joins else "started on this machine"
        raise CurateError(f"no Ray cluster could be {done}: {one_line(error, 200)}") from error


def _reason(error: Any) -> str:
    """What was raised in an actor, without Ray's account of how it got here."""
    cause = getattr(error, "cause", None)
    found = cause if isinstance(cause, Exception) else error
    return f"{type(found).__name__}: {one_line(found, 200)}"
