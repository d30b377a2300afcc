"""Trainings on several processes: the curve of one, kills, orphans, and errors."""

import logging
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.counting_detector import DELAY_S, KILL_AT, CountingDetector
from support.paths import ROOT
from support.process_tree import descendants, environment

from curate.detectors.base import TrainableDetector
from curate.detectors.pillars import PillarDetector
from curate.errors import CurateError, DataError, ModelError, ProcessDied
from curate.training.loop import TrainingJob
from curate.training.settings import TrainingReport, TrainingSettings
from curate.training.snapshot import snapshot_path
from curate.training.trainer import train

Labels = Callable[..., Path]


def trained(
    detector: type[TrainableDetector], labels: Path, output: Path, count: int, **more: Any
) -> TrainingReport:
    """Train on a number of processes, with 2 labeled frames and 1 unlabeled one per step."""
    options = {name: more.pop(name) for name in ("read", "progress", "launch") if name in more}
    settings = {
        "steps": 12, "batch_size": 2, "unlabeled_batch_size": 1, "pasted": 1,
        "statistics_steps": 1, "snapshot_seconds": 0.0, "processes": count,
    }  # fmt: skip
    return train(detector, labels, output, TrainingSettings(**settings | more), **options)


def curves(report: TrainingReport) -> dict[tuple[int, str], float]:
    """Return the values of all statistics by step and name."""
    return {(each.step, each.name): each.value for each in report.statistics}


def test_a_killed_process_costs_nothing_and_the_curve_is_that_of_one(
    make_labels: Labels, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    """Three frames on two processes in double precision; the second one is killed in step 7.

    Parts of 2 and 1 frames, batch normalisation, a loss that divides by counts of the batch, a
    layer that not every part uses, a frame without points, and the moving average as the result.
    """
    labels = make_labels(labeled=3, unlabeled=2)
    kitti = tmp_path / "kitti" / "training" / "velodyne"
    (kitti / "000003.bin").write_bytes(b"")
    alone = trained(CountingDetector, labels, tmp_path / "one.txt", 1, teacher="ema")
    monkeypatch.setenv(KILL_AT, f"7 1 {tmp_path / 'killed'}")
    with caplog.at_level(logging.WARNING):
        split = trained(CountingDetector, labels, tmp_path / "two.txt", 2, teacher="ema")
    assert (tmp_path / "killed").exists()
    [warning] = [record.message for record in caplog.records]
    assert warning == (
        "training process 2 of 2 was ended by SIGKILL, perhaps for lack of memory; the training "
        "resumes from step 6"
    )
    expected, found = curves(alone), curves(split)
    assert found.keys() == expected.keys()
    assert {step for step, _ in found} == set(range(1, 13))
    for key, value in expected.items():
        assert found[key] == pytest.approx(value, rel=1e-7, abs=1e-12), key
    assert (split.bank, split.labeled_frames, split.unlabeled_frames) == (
        alone.bank, alone.labeled_frames, alone.unlabeled_frames,
    )  # fmt: skip
    assert not snapshot_path(tmp_path / "two.txt").exists()
    one, two = (
        [line.split(" ", 1) for line in (tmp_path / name).read_text().splitlines()]
        for name in ("one.txt", "two.txt")
    )
    for (name, tensor), (other_name, other) in zip(one, two, strict=True):
        assert name == other_name
        assert _numbers(other) == pytest.approx(_numbers(tensor), rel=1e-6, abs=1e-9), name


def _numbers(text: str) -> list[float]:
    """Return the numbers of a nested list."""
    return [
        float(word) for word in text.replace("[", " ").replace("]", " ").replace(",", " ").split()
    ]


def test_the_curve_of_the_pillar_detector_is_that_of_one_process(
    make_labels: Labels, tmp_path: Path
) -> None:
    """In single precision, with small steps: rounding does not grow as fast.

    torch's own batch normalisation, which one process uses, sums less exactly.
    """
    labels = make_labels(labeled=3, unlabeled=2)
    options = {"steps": 3, "learning_rate": 1e-5}
    alone, split = (
        curves(trained(PillarDetector, labels, tmp_path / f"{n}.safetensors", n, **options))
        for n in (1, 2)
    )
    assert split.keys() == alone.keys()
    for (step, name), value in alone.items():
        assert split[step, name] == pytest.approx(value, rel=5e-3), (step, name)
    assert split[1, "heatmap"] == pytest.approx(alone[1, "heatmap"], rel=3e-4)


def test_more_processes_than_frames_are_not_started(
    make_labels: Labels, tmp_path: Path, caplog: Any
) -> None:
    """One warning with the numbers; a step of one frame is trained in this process."""
    options = {"batch_size": 1, "steps": 1}
    with caplog.at_level(logging.WARNING):
        trained(CountingDetector, make_labels(labeled=2), tmp_path / "a.txt", 9, **options)
    [warning] = [record.message for record in caplog.records]
    assert warning.startswith("1 of 9 training processes are used: a step has 1 frames")


def test_processes_that_die_again_and_again_end_the_training(
    make_labels: Labels, tmp_path: Path, caplog: Any
) -> None:
    """Bounded without a new snapshot, not bounded as long as it gets further."""
    labels, starts = make_labels(labeled=2), []

    def dying(job: TrainingJob, count: int, report: Any) -> None:
        starts.append(job.snapshot)
        raise ProcessDied("training process 1 of 2 was ended by SIGKILL")

    with pytest.raises(CurateError, match=r"4 times since step 0.*fewer processes") as caught:
        trained(CountingDetector, labels, tmp_path / "a.txt", 2, launch=dying)
    assert type(caught.value) is CurateError
    assert starts == [None] * 4
    assert caplog.text.count("resumes from step 0") == 3


def missing_frame(frame_id: str) -> None:
    """Read a frame that is not there."""
    raise DataError(f"velodyne/{frame_id}.bin: no such file")


def unreadable_frame(frame_id: str) -> None:
    """Fail as a user's reader may fail."""
    raise KeyError(f"no frame\n{frame_id}")


def test_an_error_in_a_process_is_raised_here(make_labels: Labels, tmp_path: Path) -> None:
    labels, output = make_labels(labeled=2), tmp_path / "a.txt"
    with pytest.raises(DataError, match=r"^velodyne/000000.bin: no such file$"):
        trained(CountingDetector, labels, output, 2, read=missing_frame)


@pytest.mark.slow
def test_an_error_of_a_users_class_is_one_line(make_labels: Labels, tmp_path: Path) -> None:
    labels, output = make_labels(labeled=2), tmp_path / "a.txt"
    with pytest.raises(CurateError, match=r"^training process [12] of 2: KeyError: .*no frame"):
        trained(CountingDetector, labels, output, 2, read=unreadable_frame)


def test_a_reader_that_cannot_be_sent_is_rejected(make_labels: Labels, tmp_path: Path) -> None:
    labels, output = make_labels(labeled=2), tmp_path / "a.txt"
    with pytest.raises(ModelError, match=r"picklable, or set train.processes = 1"):
        trained(CountingDetector, labels, output, 2, read=lambda _: None)


PROGRAM = """
import sys
from support.counting_detector import CountingDetector
from curate.training.settings import TrainingSettings
from curate.training.trainer import train
if __name__ == "__main__":
    settings = TrainingSettings(steps=10**6, batch_size=2, processes=2)
    train(CountingDetector, sys.argv[1], sys.argv[2], settings,
          progress=lambda step, steps, loss: print(step, flush=True))
"""


def test_no_process_survives_a_killed_caller(make_labels: Labels, tmp_path: Path) -> None:
    """SIGKILL for the calling process while the others train; nothing is left to clean up."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    started = subprocess.Popen(
        [sys.executable, program, make_labels(labeled=2), tmp_path / "a.txt"],
        env=environment(**{DELAY_S: "0.05"}),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=ROOT,
    )
    assert started.stdout is not None
    assert started.stderr is not None
    with started.stdout, started.stderr:
        assert started.stdout.readline() == b"1\n"
        below = descendants(started.pid)
        assert len(below) >= 2
        started.send_signal(signal.SIGKILL)
        started.wait()
        assert started.stderr.read() == b""  # ends when the last process has ended
    end = time.monotonic() + 30
    while any(map(_runs, below)) and time.monotonic() < end:
        time.sleep(0.05)
    assert [pid for pid in below if _runs(pid)] == []


def _runs(pid: int) -> bool:
    """Return whether a process runs; a zombie that nobody waits for does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"
