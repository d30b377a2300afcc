"""Where a training runs: in this process, in several of this machine, or on a Ray cluster."""

from typing import Literal

from curate.training.processes import Launch, run_in_processes
from curate.warnings_once import warn_once
from pipelines.engine.executors.machine import affordable_workers, usable_cores
from pipelines.workspace.config import Config

# What a process of a training needs besides its share of the frames that are kept in memory: 540
# MiB were measured for the smallest preset.
_PROCESS_BYTES = 1 << 30
# Processes take about 5 s to start. A shorter training ends earlier in one.
_WORTH_STEPS = 100


def plan_training(config: Config, steps: int, frames: int, device: str) -> tuple[int, Launch]:
    """Return the number of processes of a training, and what starts them.

    It gives one warning if this machine is too small. On a Ray cluster the nodes have the cores and
    the memory.

    Args:
        config: the configuration.
        steps: steps of the training.
        frames: frames per step; "auto" starts no more processes.
        device: torch device of the training.
    """
    wanted = config.train.processes
    if wanted == 1 or (wanted == "auto" and steps < _WORTH_STEPS):
        return 1, run_in_processes
    if config.run.executor == "ray":
        from pipelines.engine.ray_training import RayTraining

        cluster = RayTraining(**config.run.executor_options.get("ray", {}))
        return min(cluster.places(), frames) if wanted == "auto" else wanted, cluster
    return _processes_here(wanted, config.train.threads, frames, device), run_in_processes


def _processes_here(wanted: int | Literal["auto"], threads: int, frames: int, device: str) -> int:
    """Return the number of processes on this machine."""
    if device.startswith("cuda"):
        from torch import cuda

        return min(cuda.device_count(), frames) if wanted == "auto" else wanted
    places = max(1, usable_cores() // threads)
    count = min(places if wanted == "auto" else wanted, frames)
    allowed = affordable_workers(count, _PROCESS_BYTES)
    if allowed < count or wanted == "auto":
        return allowed
    if count > places:
        warn_once(
            f"train.processes is {wanted} and train.threads {threads}, but only {usable_cores()} "
            "cores can be used: a training with more processes than cores is slower"
        )
        return count
    return wanted  # the training reports processes without a frame
