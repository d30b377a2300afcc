"""The simulated dataset on disk: determinism, resuming, rejections."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.paths import ROOT

from curate.datasets.kitti.calibration import read_calibration
from curate.datasets.kitti.dataset import KittiDataset
from curate.errors import ConfigError, DataError
from curate.evaluation.camera_examination import examine_camera
from curate.evaluation.examination import examine_frame
from curate.evaluation.label_examination import examine_labels
from curate.simulation import simulate
from curate.simulation.rig import CameraRig

FRAMES, SEED = 8, 5  # of the fixture `simulated`
FOLDERS = {"velodyne", "image_2", "semantic_2", "calib", "label_2"}


def contents(root, frames):
    """Return the bytes of every file of some frames."""
    return {
        path.relative_to(root): path.read_bytes()
        for number in frames
        for path in sorted((root / "training").glob(f"*/{number:06d}.*"))
    }


def test_the_kitti_reader_reads_it(simulated):
    """Frames, splits, points, image and labels, like any KITTI folder."""
    dataset = KittiDataset(simulated)
    names = tuple(f"{number:06d}" for number in range(FRAMES))
    assert dataset.frame_ids() == names
    assert dataset.splits() == {"train": names[:6], "val": names[6:], "trainval": names}
    frame = dataset.read("000003", image=True)
    assert 20_000 < len(frame.points) < 40_000
    assert frame.image_size == (1242, 375)
    assert frame.image.shape == (375, 1242, 3)
    assert len(dataset.annotations("000003")) > 0


def test_calibration_has_kittis_form_and_differs_between_frames(simulated):
    """R0_rect is a rotation and not the identity, and every frame has its own rig."""
    rigs = [CameraRig.draw(np.random.default_rng([SEED, number, 2])) for number in range(2)]
    for number, rig in enumerate(rigs):
        found = read_calibration(simulated / "training" / "calib" / f"{number:06d}.txt")
        np.testing.assert_allclose(found.projection, rig.projection, atol=1e-9)
        np.testing.assert_allclose(
            found.lidar_to_camera, rig.calibration.lidar_to_camera, atol=1e-9
        )
        np.testing.assert_allclose(rig.rectification @ rig.rectification.T, np.eye(3), atol=1e-12)
        assert np.abs(rig.rectification - np.eye(3)).max() > 1e-3
    assert not np.allclose(rigs[0].projection, rigs[1].projection)


def test_workers_and_the_number_of_frames_change_nothing(simulated, tmp_path):
    """Frame i has the same bytes, simulated by two processes in a dataset of three frames."""
    simulate(tmp_path / "other", 3, SEED, workers=2)
    expected = contents(simulated, range(3))
    assert len(expected) == 3 * len(FOLDERS)
    assert contents(tmp_path / "other", range(3)) == expected


def test_another_seed_gives_other_files(simulated, tmp_path):
    """No file of a frame is the same."""
    simulate(tmp_path / "other", 1, SEED + 1, workers=1)
    ours, theirs = contents(tmp_path / "other", [0]), contents(simulated, [0])
    assert all(ours[name] != theirs[name] for name in theirs)


def test_a_killed_simulation_resumes(simulated, tmp_path):
    """After SIGKILL no worker stays, complete frames are kept, and the rest is the same."""
    root = tmp_path / "killed"
    code = f"""
from pathlib import Path
from curate.simulation import simulate
simulate(Path({str(root)!r}), {FRAMES}, {SEED}, workers=2)
"""
    running = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT)
    labels = root / "training" / "label_2"
    wait_until(lambda: len(list(labels.glob("*.txt"))) >= 2 or running.poll() is not None)
    children = Path(f"/proc/{running.pid}/task/{running.pid}/children").read_text().split()
    os.kill(running.pid, signal.SIGKILL)
    assert running.wait() == -signal.SIGKILL
    wait_until(lambda: not any(is_running(int(child)) for child in children))
    assert not (root / "ImageSets").exists()
    finished = {path: path.stat().st_mtime_ns for path in labels.glob("*.txt")}
    assert 2 <= len(finished) < FRAMES

    steps = []
    simulate(root, FRAMES, SEED, workers=1, progress=lambda *step: steps.append(step))
    assert steps[0] == (len(finished), FRAMES)
    assert steps[-1] == (FRAMES, FRAMES)
    assert all(path.stat().st_mtime_ns == then for path, then in finished.items())
    assert contents(root, range(FRAMES)) == contents(simulated, range(FRAMES))
    assert not list(root.rglob("*.partial"))


def test_a_script_without_main_guard_is_reported(tmp_path):
    """In the last line, without a traceback from every worker; nothing hangs."""
    script = tmp_path / "script.py"
    script.write_text(
        "from pathlib import Path\nfrom curate.simulation import simulate\n"
        f"simulate(Path({str(tmp_path / 'data')!r}), 3, {SEED}, workers=2)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    ended = subprocess.run(
        [sys.executable, script], env=environment, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 1
    assert 'outside of `if __name__ == "__main__":`' in ended.stderr.splitlines()[-1]
    assert ended.stderr.count("Traceback") == 1


def test_a_frame_with_a_missing_file_is_simulated_again(simulated, tmp_path):
    """A label without its image is not a complete frame."""
    simulate(tmp_path / "data", 1, SEED, workers=1)
    (tmp_path / "data" / "training" / "image_2" / "000000.png").unlink()
    simulate(tmp_path / "data", 1, SEED, workers=1)
    assert contents(tmp_path / "data", [0]) == contents(simulated, [0])


@pytest.mark.parametrize("change", [{"seed": SEED + 1}, {"frames": FRAMES + 1}, {"val_frames": 1}])
def test_a_directory_of_another_simulation_is_rejected(simulated, change):
    """The one-line error contains both settings, and nothing is written."""
    settings = {"frames": FRAMES, "seed": SEED} | change
    with pytest.raises(ConfigError, match=f"seed={SEED}") as caught:
        simulate(simulated, **settings, workers=1)
    assert "\n" not in str(caught.value)
    assert len(KittiDataset(simulated).frame_ids()) == FRAMES


def test_other_datasets_are_never_overwritten(tmp_path):
    """A folder with training/ but without simulation.json is not a simulation."""
    (tmp_path / "training").mkdir()
    with pytest.raises(DataError, match="was not simulated"):
        simulate(tmp_path, 1, 0, workers=1)


def test_a_directory_that_cannot_be_written_is_reported(tmp_path):
    """In one line."""
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="file: cannot be written"):
        simulate(tmp_path / "file", 1, 0, workers=1)


@pytest.mark.parametrize("text", ["{", "[]", '{"seed": 1}'])
def test_a_damaged_settings_file_is_reported(tmp_path, text):
    """In one line."""
    (tmp_path / "simulation.json").write_text(text)
    with pytest.raises(DataError, match=r"simulation\.json: damaged"):
        simulate(tmp_path, 1, 0, workers=1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"frames": 0}, "frames must be"),
        ({"seed": -1}, "seed must be at least 0"),
        ({"val_frames": 4}, "val_frames must be"),
        ({"workers": 0}, "workers must be"),
    ],
)
def test_numbers_out_of_range_are_rejected(tmp_path, arguments, message):
    """Before anything is written."""
    with pytest.raises(ConfigError, match=message):
        simulate(tmp_path / "data", **({"frames": 4, "seed": 0, "workers": 1} | arguments))
    assert not (tmp_path / "data").exists()


def wait_until(happened, seconds=600):
    """Poll until a condition holds; fail the test if it does not."""
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.02)


def is_running(pid):
    """Return whether a process exists and is not a zombie."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_doctor_has_nothing_to_report(simulated):
    """Neither in a single frame nor in several; wrong labels are found."""
    dataset = KittiDataset(simulated)
    labeled = [(dataset.read(name), dataset.annotations(name)) for name in dataset.frame_ids()]
    for group in [*[[each] for each in labeled], labeled[:5]]:
        found = [*examine_frame(group[0][0]), *examine_camera(group[0][0]), *examine_labels(group)]
        assert {one.state for one in found} == {"ok"}, found
    swapped = [
        (frame, replace(truth, boxes=truth.boxes[:, [0, 1, 2, 4, 3, 5, 6]]))
        for frame, truth in labeled[:5]
    ]
    assert "length and width are swapped" in examine_labels(swapped)[1].message
