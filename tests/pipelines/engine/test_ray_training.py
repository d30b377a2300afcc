"""A training on a Ray cluster: the curve of one process, errors, and a killed node."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from support.counting_detector import DELAY_S, CountingDetector
from support.frame_functions import Square
from support.process_tree import descendants
from support.toys import write_toy_kitti

from curate.datasets.kitti.dataset import KittiDataset
from curate.errors import CurateError, DataError
from curate.training.settings import TrainingReport, TrainingSettings
from curate.training.trainer import train
from pipelines.assembly import Place
from pipelines.engine.executors.base import FrameJob
from pipelines.engine.executors.ray import RayExecutor
from pipelines.engine.ray_training import RayTraining
from pipelines.stages.predict import Predict
from pipelines.workspace.config import make_config

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install '.[ray]'")

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of Ray's own modules

Labels = Callable[..., Path]


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """Start a cluster with two CPUs on this machine, for all tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_worker_niceness", "0")
        patch.setenv(DELAY_S, "0.05")  # per step; the nodes pass it on
        made = RayExecutor(2)  # its cluster lives until it is closed
        list(made.map(Square(), [FrameJob(key, str(key)) for key in range(4)]))
        yield
        made.close()


def trained(labels: Path, output: Path, count: int, **more: Any) -> TrainingReport:
    """Train with 2 labeled frames and 1 unlabeled one per step."""
    options = {name: more.pop(name) for name in ("read", "progress", "launch") if name in more}
    settings = {
        "steps": 6, "batch_size": 2, "unlabeled_batch_size": 1, "pasted": 1,
        "statistics_steps": 1, "snapshot_seconds": 0.0, "processes": count,
    }  # fmt: skip
    return train(CountingDetector, labels, output, TrainingSettings(**settings | more), **options)


def test_the_curve_is_that_of_one_process(
    cluster: None, make_labels: Labels, tmp_path: Path
) -> None:
    """The workers find room, although an executor had filled the cluster with its actors."""
    labels, steps = make_labels(labeled=3, unlabeled=2), []
    alone = trained(labels, tmp_path / "one.txt", 1)
    split = trained(
        labels, tmp_path / "two.txt", 2, launch=RayTraining(),
        progress=lambda step, total, loss: steps.append(step),
    )  # fmt: skip
    assert steps == [1, 2, 3, 4, 5, 6]
    for expected, found in zip(alone.statistics, split.statistics, strict=True):
        assert (found.step, found.name) == (expected.step, expected.name)
        assert found.value == pytest.approx(expected.value, rel=1e-7, abs=1e-12)
    assert (tmp_path / "two.txt").exists()


def test_nodes_without_the_data_set_end_the_training_at_the_start(
    cluster: None, make_labels: Labels, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line: the file, the node, and what to do. Only this process has the path."""
    labels, steps = make_labels(labeled=2), []
    monkeypatch.chdir(tmp_path)
    read = KittiDataset(Path("/proc/self/cwd/kitti")).read
    read("000000")
    with pytest.raises(DataError, match=r"on node .*needs the data set at the same path") as caught:
        trained(
            labels, tmp_path / "a.txt", 2, read=read, launch=RayTraining(),
            progress=lambda *step: steps.append(step),
        )  # fmt: skip
    assert "/proc/self/cwd/kitti" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert steps == []


def test_frames_without_the_data_set_end_the_run_at_the_start(
    cluster: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same line when the frames of a stage are sent to the nodes."""
    write_toy_kitti(tmp_path / "kitti", frames=2, val=1)
    monkeypatch.chdir(tmp_path)
    document = {"dataset": {"root": "/proc/self/cwd/kitti"}}
    executor = RayExecutor(1)
    function = Predict(
        make_config(document, "test"), tmp_path / "teacher.safetensors", Place(tmp_path, 1)
    )
    with pytest.raises(DataError, match=r"/proc/self/cwd/kitti.*on node .*at the same path"):
        list(executor.map(function, [FrameJob(0, "000000")]))
    executor.close()


def test_a_cluster_without_room_is_reported_at_once(
    cluster: None, make_labels: Labels, tmp_path: Path
) -> None:
    with pytest.raises(CurateError, match=r"no room for 3 training processes.*have 2 CPUs"):
        trained(make_labels(labeled=3, unlabeled=1), tmp_path / "a.txt", 3, launch=RayTraining())


@pytest.mark.slow
def test_a_killed_worker_ends_in_a_resumed_training(
    cluster: None, make_labels: Labels, tmp_path: Path, caplog: Any
) -> None:
    """SIGKILL for a worker of Ray Train while it trains."""
    labels, killed = make_labels(labeled=3, unlabeled=2), threading.Event()
    alone = trained(labels, tmp_path / "one.txt", 1, steps=80)

    def kill(step: int, total: int, loss: float) -> None:
        if step >= 3 and not killed.is_set():
            killed.set()
            [pid, *_] = _train_workers()
            os.kill(pid, signal.SIGKILL)

    split = trained(labels, tmp_path / "two.txt", 2, steps=80, launch=RayTraining(), progress=kill)
    assert killed.is_set()
    assert "the training resumes from step" in caplog.text
    for expected, found in zip(alone.statistics, split.statistics, strict=True):
        assert found.value == pytest.approx(expected.value, rel=1e-5, abs=1e-9)


def _train_workers() -> list[int]:
    """Return the worker processes of Ray Train below this process."""
    titles = {pid: Path(f"/proc/{pid}/cmdline").read_bytes() for pid in descendants(os.getpid())}
    found = [pid for pid, title in titles.items() if b"TrainWorker" in title]
    assert found, titles
    return found
