"""The executor for several machines: a pool of Ray actors, each with its own model.

The runner stays the only writer. Actors receive the name and the stored data of a frame, and return
its rows. Every node needs the same version of curate, and the data set at the same path.
"""

import os
import pickle
import socket
import sys
import time
import weakref
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from curate.errors import ConfigError, CurateError, DataError, one_line
from curate.ranges import AboveZero, AtLeastOne, NotNegative
from pipelines.engine.executors.base import (
    FunctionHolder,
    Job,
    JobFunction,
    JobQueue,
    Outcome,
    allowed_workers,
    outcomes_of,
)
from pipelines.engine.executors.machine import usable_cores

POLL_S = 5.0
# Jobs and rows are small; by default Ray reserves a third of a machine's memory.
OBJECT_STORE_BYTES = 256 * 1024**2


class RayExecutor:
    """Processes frames in `workers` actors, which live until `close`.

    Args:
        workers: number of actors; those that the cluster has no resources for wait. None for as
            many as the cluster has resources for when it is joined.
        address: address of a running cluster, e.g. "auto" or "10.0.0.1:6379"; None joins the
            cluster in RAY_ADDRESS, or starts one on this machine.
        num_cpus: CPUs per actor.
        num_gpus: GPUs per actor; a fraction if several actors share one.
        start_timeout_s: time limit for the cluster to place the first actor.

    Raises:
        ConfigError: if Ray is not installed.
        CurateError: if the cluster cannot be joined or started.
    """

    def __init__(
        self,
        workers: AtLeastOne | None = None,
        *,
        address: str | None = None,
        num_cpus: NotNegative = 1.0,
        num_gpus: NotNegative = 0.0,
        start_timeout_s: AboveZero = 120.0,
    ) -> None:
        self.start_timeout_s = start_timeout_s
        self._ray = import_ray()
        self._needs = {"num_cpus": num_cpus, "num_gpus": num_gpus}
        self._owns_cluster = not self._ray.is_initialized()
        if self._owns_cluster:
            join_cluster(self._ray, address, workers or 1)
        self.workers = workers or places(self._ray, self._needs)
        # Ray must not restart a crashed actor: the executor replaces it by a new one, and so knows
        # which frame it was processing.
        options = {**self._needs, "max_restarts": 0, "scheduling_strategy": "SPREAD"}
        self._actor_class = self._ray.remote(**options)(RemoteHolder)
        self._actors: list[_Actor] = []
        _executors.add(self)

    def map(self, function: JobFunction, jobs: Iterable[Job]) -> Iterator[Outcome]:
        """Yield one outcome per frame or sequence, in the order in which they end.

        Raises:
            CurateError: if the models cannot be loaded, actors crash while they load them, or the
                cluster has no resources for a single actor.
        """
        workers = allowed_workers(function, self.workers)
        queue = JobQueue(jobs, workers)
        packed = pickle.dumps(function)
        placed_at = time.monotonic()
        try:
            while self._dispatch(packed, queue, workers):
                heads = {actor.head(): actor for actor in self._actors if actor.results}
                ready, _ = self._ray.wait(list(heads), num_returns=1, timeout=POLL_S)
                for ref in ready:
                    yield from self._collect(heads[ref], queue)
                if any(actor.placed for actor in self._actors):
                    placed_at = time.monotonic()
                self._check_placement_timeout(placed_at)
        finally:
            for actor in [actor for actor in self._actors if actor.results]:
                self._dismiss(actor)

    def close(self) -> None:
        """End the actors, and the cluster if it was started here."""
        self.free_resources()
        if self._owns_cluster:
            self._ray.shutdown()

    def free_resources(self) -> None:
        """End the actors; the next `map` starts new ones."""
        for actor in list(self._actors):
            self._dismiss(actor)

    def _dispatch(self, packed: bytes, queue: JobQueue, workers: int) -> bool:
        """Send jobs to the actors that have loaded their models; return whether any are left."""
        while (job := queue.take()) is not None:
            while len(self._actors) < workers:
                self._actors.append(_Actor(self._actor_class.remote(sys.path)))
            crew = self._actors[:workers]
            for actor in crew:
                actor.open(packed)
            free = [actor for actor in crew if actor.opened and queue.allows_another(actor.jobs)]
            if not free:
                queue.return_jobs([job])
                return True
            min(free, key=lambda actor: len(actor.jobs)).send(job)
        return any(actor.jobs for actor in self._actors)

    def _collect(self, actor: "_Actor", queue: JobQueue) -> Iterator[Outcome]:
        """Yield the oldest outcome of an actor; if it has crashed, those of its failed jobs."""
        try:
            result = self._ray.get(actor.head())
        except self._ray.exceptions.RayTaskError as error:
            raise CurateError(f"a Ray actor failed: {_reason(error)}") from error
        except self._ray.exceptions.RayError as error:
            jobs, opened = list(actor.jobs), actor.opened
            self._dismiss(actor)
            yield from queue.record_crash(jobs, _reason(error), opened=opened)
            return
        if isinstance(result, CurateError):
            raise result
        actor.results.popleft()
        if actor.opened:
            yield from outcomes_of(actor.jobs.popleft(), result)
        elif actor.placed:
            actor.opened = True
            queue.record_opened()
        else:
            actor.placed = True

    def _dismiss(self, actor: "_Actor") -> None:
        self._actors.remove(actor)
        self._ray.kill(actor.handle)

    def _check_placement_timeout(self, placed_at: float) -> None:
        if time.monotonic() - placed_at > self.start_timeout_s:
            offered = self._ray.cluster_resources()
            raise CurateError(
                f"the Ray cluster has placed no actor in {self.start_timeout_s:.0f} s; each needs "
                f"{self._needs}, and all nodes together have {offered.get('CPU', 0):g} CPUs and "
                f"{offered.get('GPU', 0):g} GPUs; change run.executor_options.ray in curate.toml"
            )


class RemoteHolder(FunctionHolder):
    """The class of the actors, which runs on the nodes of the cluster."""

    def __init__(self, search_path: Sequence[str]) -> None:
        super().__init__()
        # The actor must find the same user modules as the driver.
        sys.path += [path for path in search_path if path not in sys.path]

    def open(self, packed: bytes) -> CurateError | None:
        """Load a function as `FunctionHolder.open`; an error in the data set names the node."""
        error = super().open(packed)
        return on_this_node(error) if isinstance(error, DataError) else error

    def place(self) -> None:
        """Do nothing; the call returns once the cluster has placed the actor."""


class _Actor:
    """The handle of an actor, with its calls in flight in the order in which they return."""

    def __init__(self, handle: Any) -> None:
        self.handle = handle
        self.jobs: deque[Job] = deque()
        self.results: deque[Any] = deque([handle.place.remote()])
        self.placed = False
        self.opened = False
        self._packed = b""

    def head(self) -> Any:
        """Return the reference of the oldest result that has not been read."""
        return self.results[0]

    def open(self, packed: bytes) -> None:
        """Make the actor load a function's models, unless it has loaded them."""
        if packed != self._packed:
            self._packed, self.opened = packed, False
            self.results.append(self.handle.open.remote(packed))

    def send(self, job: Job) -> None:
        """Send a job."""
        self.jobs.append(job)
        self.results.append(self.handle.work.remote(job))


# The executors of this process. Idle actors keep their CPUs, which a training needs.
_executors: "weakref.WeakSet[RayExecutor]" = weakref.WeakSet()


def free_resources() -> None:
    """End the actors of all executors of this process, so that other work finds room."""
    for executor in list(_executors):
        executor.free_resources()


def import_ray() -> Any:
    """Return the package `ray`.

    Raises:
        ConfigError: if it is not installed.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise ConfigError(
            "executor 'ray': Ray is not installed; pip install 'curate-pseudo-labels[ray]'"
        ) from error
    return ray


def on_this_node(error: DataError) -> DataError:
    """Return an error in the data set with the node on which it was found, and what to do."""
    return DataError(
        f"{error} (on node {socket.gethostname()}; every node of a Ray cluster needs the data set "
        "at the same path)"
    )


@contextmanager
def joined(address: str | None, workers: int) -> Iterator[Any]:
    """Yield the package `ray` in a cluster: the one that this process is in, or else a new one."""
    ray = import_ray()
    joins = not ray.is_initialized()
    if joins:
        join_cluster(ray, address, workers)
    try:
        yield ray
    finally:
        if joins:
            ray.shutdown()


def places(ray: Any, needs: Mapping[str, float]) -> int:
    """Return for how many workers with these needs the cluster has resources, at least 1."""
    offered, names = ray.cluster_resources(), {"num_cpus": "CPU", "num_gpus": "GPU"}
    found = [int(offered.get(names[key], 0) / need) for key, need in needs.items() if need]
    return max(1, min(found, default=1))


def join_cluster(ray: Any, address: str | None, workers: int) -> None:
    """Join a cluster, or start one with at least one CPU per worker.

    Raises:
        CurateError: if that is not possible.
    """
    address = address or os.environ.get("RAY_ADDRESS")
    options: dict[str, Any] = (
        {"address": address}
        if address
        else {
            "address": "local",  # a new one, even if another one runs on this machine
            "num_cpus": max(workers, usable_cores()),
            "object_store_memory": OBJECT_STORE_BYTES,
            "include_dashboard": False,
        }
    )
    try:
        # Runs before Ray imports the actor's class: PYTHONPATH may have packages of the same name.
        hook = {"worker_process_setup_hook": "curate_command.claim_packages"}
        ray.init(**options, runtime_env=hook, logging_level="ERROR", log_to_driver=False)
    except Exception as error:  # Ray raises exceptions of many types
        failed = f"joined at {address}" if address else "started on this machine"
        raise CurateError(f"no Ray cluster could be {failed}: {one_line(error, 200)}") from error


def _reason(error: Any) -> str:
    """Return the error that was raised in an actor in one line, without Ray's traceback."""
    cause = getattr(error, "cause", None)
    raised = cause if isinstance(cause, Exception) else error
    return f"{type(raised).__name__}: {one_line(raised, 200)}"
