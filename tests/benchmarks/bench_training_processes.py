"""Training on one and on two processes: the first teacher, in steps per second by the clock."""

import time
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from threading import Thread

import pytest
from benchmarks.measuring import measure

from curate.detectors.pillars import PillarDetector
from curate.simulation import simulate
from curate.training.settings import TrainingSettings
from curate.training.trainer import train
from pipelines.stages.export import write_label_file
from pipelines.stages.train_round import FrameReader
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise

pytestmark = pytest.mark.benchmark(timer=time.perf_counter)

FRAMES = 16
FIRST, STEPS = 10, 70  # the steps before the first include the start of the processes
ROUNDS = 3
GROUP = "Train the first teacher (small, 2 frames per step) by the clock, without the start"


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], SimpleQueue[int]]:
    """Return a function that starts a training and returns its steps once the first are done."""
    home = tmp_path_factory.mktemp("training")
    simulate(home / "data", FRAMES, 0, val_frames=0, workers=1)
    config = make_config({"dataset": {"root": home / "data"}}, "benchmark")
    workspace = initialise(home / "work", config, "1.0", "")
    labels = home / "labels.sqlite"
    write_label_file(workspace, labels, 0, "")
    read = FrameReader(workspace.config)

    def start(processes: int) -> SimpleQueue[int]:
        settings = TrainingSettings(
            steps=STEPS, unlabeled_batch_size=0, processes=processes, snapshot_seconds=1e9
        )
        steps: SimpleQueue[int] = SimpleQueue()
        Thread(
            target=train,
            args=(PillarDetector, labels, Path(home / "teacher.safetensors"), settings),
            kwargs={"read": read, "progress": lambda step, *_: steps.put(step)},
        ).start()
        while steps.get(timeout=300) < FIRST:
            pass
        return steps

    return start


@pytest.mark.parametrize("processes", [1, 2])
def bench_train(benchmark, started, processes):
    """From the tenth step to the last."""

    def finish(steps: SimpleQueue[int]) -> None:
        while steps.get(timeout=300) < STEPS:
            pass

    measure(
        benchmark,
        finish,
        group=GROUP,
        name=f"{processes} process{'es' * (processes > 1)}",
        amount=STEPS - FIRST,
        unit="steps",
        setup=lambda: ((started(processes),), {}),
        rounds=ROUNDS,
        figure="rate",
    )
