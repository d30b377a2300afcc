"""A training on the nodes of a Ray cluster, by Ray Train.

Ray Train starts the workers and joins them into a group of `torch.distributed`; each runs the same
steps as a process of this machine. The driver stays the only writer: the first worker puts its
messages into a mailbox on the driver's node. Every node needs the same version of curate, and the
data set at the same path.
"""

import logging
import pickle
import sys
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import Future, wait
from threading import Thread
from typing import Any

from curate.errors import CurateError, DataError, ProcessDied, one_line
from curate.training.loop import Place, Report, Trained, TrainingJob, run_steps
from curate.training.processes import TIMEOUT, packed_job
from pipelines.engine.executors.ray import free_resources, import_ray, joined, on_this_node, places

_POLL_S = 0.2
# How long to wait for Ray Train to end its workers.
_END_S = 30.0


class RayTraining:
    """Starts the processes of a training as workers of Ray Train; see `Launch`.

    Args:
        address: see `RayExecutor`.
        num_cpus: CPUs per worker.
        num_gpus: GPUs per worker; above 0, each trains on its GPU.
        start_timeout_s: time limit for the cluster to start the workers.
    """

    def __init__(
        self,
        *,
        address: str | None = None,
        num_cpus: float = 1.0,
        num_gpus: float = 0.0,
        start_timeout_s: float = 120.0,
    ) -> None:
        self._address = address
        self._needs = {"num_cpus": num_cpus, "num_gpus": num_gpus}
        self._start_timeout_s = start_timeout_s

    def places(self) -> int:
        """Return for how many workers the cluster has resources, at least 1."""
        with joined(self._address, 1) as ray:
            return places(ray, self._needs)

    def __call__(self, job: TrainingJob, processes: int, report: Report) -> None:
        """Train in workers of the cluster.

        Raises:
            ConfigError: if Ray Train is not installed.
            ProcessDied: if a worker died.
            CurateError: if a worker failed, or the cluster has no resources for the workers.
        """
        import_ray()
        packed = packed_job(job)
        with joined(self._address, processes) as ray:
            if places(ray, self._needs) < processes:
                raise CurateError(self._no_room(ray, processes))
            free_resources()
            mailbox = ray.remote(num_cpus=0)(Mailbox).remote()
            config = {"job": ray.put(packed), "mailbox": mailbox, "search_path": sys.path}
            with tempfile.TemporaryDirectory(prefix="curate-training-") as folder:
                fit = _start(config, processes, self._needs, folder)
                self._pass_on(ray, mailbox, fit, processes, report)

    def _pass_on(
        self, ray: Any, mailbox: Any, fit: "Future[None]", processes: int, report: Report
    ) -> None:
        """Pass on the messages of the first worker until the training has ended."""
        began, started = time.monotonic(), False
        while True:
            ended = fit.done()  # before the last messages are taken
            for packed in ray.get(mailbox.take.remote()):
                message = pickle.loads(packed)  # noqa: S301 - of our worker
                started = True
                if isinstance(message, CurateError | Trained):
                    wait([fit], _END_S)  # Ray Train ends its workers
                if isinstance(message, CurateError):
                    raise message
                report(message)
                if isinstance(message, Trained):
                    return
            if ended:
                raise _reason(fit.exception())
            if not started and time.monotonic() - began > self._start_timeout_s:
                raise CurateError(
                    f"after {self._start_timeout_s:.0f} s, {self._no_room(ray, processes)}"
                )
            time.sleep(_POLL_S)

    def _no_room(self, ray: Any, processes: int) -> str:
        offered = ray.cluster_resources()
        return (
            f"the Ray cluster has no room for {processes} training processes; each needs "
            f"{self._needs}, and all nodes together have {offered.get('CPU', 0):g} CPUs and "
            f"{offered.get('GPU', 0):g} GPUs; change train.processes or "
            "run.executor_options.ray in curate.toml"
        )


class Mailbox:
    """The class of the actor with the messages of the workers, in order."""

    def __init__(self) -> None:
        self._messages: list[bytes] = []

    def put(self, message: bytes) -> None:
        """Add a message."""
        self._messages.append(message)

    def take(self) -> list[bytes]:
        """Return the messages that are new since the last call."""
        taken, self._messages = self._messages, []
        return taken


def _start(
    config: Mapping[str, Any], processes: int, needs: Mapping[str, float], folder: str
) -> "Future[None]":
    """Start Ray Train, and return what holds its end."""
    from ray.train import FailureConfig, RunConfig, ScalingConfig
    from ray.train.torch import TorchConfig, TorchTrainer

    logging.getLogger("ray").setLevel(logging.ERROR)
    on_gpu = needs["num_gpus"] > 0
    trainer = TorchTrainer(
        train_on_node,
        train_loop_config=dict(config),
        scaling_config=ScalingConfig(
            num_workers=processes,
            use_gpu=on_gpu,
            resources_per_worker={"CPU": needs["num_cpus"]}
            | ({"GPU": needs["num_gpus"]} if on_gpu else {}),
            placement_strategy="SPREAD",
        ),
        torch_config=TorchConfig(
            backend="nccl" if on_gpu else "gloo", timeout_s=int(TIMEOUT.total_seconds())
        ),
        run_config=RunConfig(
            storage_path=folder,
            # The driver has the snapshot, so it restarts the training.
            failure_config=FailureConfig(max_failures=0),
        ),
    )
    ended: Future[None] = Future()

    def fit() -> None:
        try:
            trainer.fit()
        except BaseException as error:  # noqa: BLE001 - Ray raises exceptions of many types
            ended.set_exception(error)
        else:
            ended.set_result(None)

    Thread(target=fit, daemon=True).start()
    return ended


def train_on_node(config: Mapping[str, Any]) -> None:
    """Run the steps of one worker."""
    import ray
    import ray.train
    from ray.train.torch import get_device

    # The worker must find the same user modules as the driver.
    sys.path += [path for path in config["search_path"] if path not in sys.path]
    job: TrainingJob = pickle.loads(ray.get(config["job"]))  # noqa: S301 - of the driver
    context, mailbox = ray.train.get_context(), config["mailbox"]
    rank = context.get_world_rank()

    def send(message: object) -> None:
        sent = mailbox.put.remote(pickle.dumps(message))
        if isinstance(message, Trained | CurateError):
            ray.get(sent)

    place = Place(str(get_device()), rank, context.get_world_size())
    try:
        run_steps(job, place, send if rank == 0 else lambda _: None)
    except DataError as error:
        send(on_this_node(error))
        raise
    except CurateError as error:
        send(error)
        raise


# Names of errors of a worker that has died, and parts of the messages of those that miss it.
_DEATHS = ("RayActorError", "ActorDiedError", "ActorUnavailableError", "WorkerHealthCheckFailed")
_MISSED = ("closed by peer", "reset by peer")


def _reason(error: Any) -> CurateError:
    """Return the error to raise for an error of Ray Train."""
    from ray.train import TrainingFailedError

    failures = sorted(getattr(error, "worker_failures", {}).items())
    for rank, failure in failures:
        name, text = type(failure).__name__, str(failure)
        if name.startswith(_DEATHS) or any(part in text for part in _MISSED):
            return ProcessDied(f"training process {rank + 1} on the Ray cluster died ({name})")
    for rank, failure in failures:
        reason = f"{type(failure).__name__}: {one_line(failure, 500)}"
        return CurateError(f"training process {rank + 1}: {reason}")
    if isinstance(error, TrainingFailedError):
        return ProcessDied(f"Ray Train failed: {one_line(error, 300)}")
    return CurateError(f"Ray Train cannot train: {type(error).__name__}: {one_line(error, 300)}")
