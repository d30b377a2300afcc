"""A detector that runs a command: what it gets, what it returns, and what it may do wrong."""

import fcntl
import os
import time
from pathlib import Path

import numpy as np
import pytest
from contracts.samples import assert_one_line
from support.external_detector import command_of, write_script
from support.toys import write_toy_kitti

from curate.datasets.kitti.dataset import KittiDataset
from curate.detections import Detections
from curate.detectors.command import CommandDetector
from curate.detectors.command.batch_folders import BatchFolders
from curate.errors import ConfigError, CurateError, DataError, ModelError
from curate.geometry.similarity import Similarity

FRAMES = ("000000", "000001", "000002", "000003")
TURNED = Similarity(flip_y=True, rotation_rad=0.7, scale=1.05)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a toy data set of four frames."""
    root = tmp_path_factory.mktemp("data")
    write_toy_kitti(root, frames=4)
    return root


@pytest.fixture
def script(tmp_path: Path) -> Path:
    """Return the script of the detector."""
    return write_script(tmp_path)


def detector(root: Path, folder: Path, command: str, **options) -> CommandDetector:
    """Return a detector in a workspace."""
    return CommandDetector(
        options.pop("path", None),
        command=command,
        open_dataset=lambda: KittiDataset(root),
        folder=folder,
        **options,
    )


def failure(made: CommandDetector, frames: tuple[str, ...] = FRAMES) -> CurateError:
    """Return the only error of a batch."""
    found = made.predict_copies(dict.fromkeys(frames))
    assert {type(each) for each in found} == {ModelError}
    assert len({str(each) for each in found}) == 1
    assert_one_line(found[0])
    return found[0]


def test_a_batch_has_the_boxes_of_its_frames(root: Path, tmp_path: Path, script: Path) -> None:
    """In the order of the frames, and nothing but a log is left."""
    made = detector(root, tmp_path, command_of(script))
    found = made.predict_copies(dict.fromkeys(reversed(FRAMES)))
    for frame_id, each in zip(reversed(FRAMES), found, strict=True):
        truth = KittiDataset(root).annotations(frame_id)
        assert isinstance(each, Detections)
        assert each.categories.tolist() == truth.categories.tolist()
        np.testing.assert_allclose(each.boxes[:, :2], truth.boxes[:, :2], atol=0.6)
    assert list((tmp_path / "batches").iterdir()) == []
    log = (tmp_path / "logs" / "round-1-000003.log").read_text()
    assert log.startswith("$ ")
    assert log.endswith("mode normal\n")


def test_boxes_of_copies_are_in_the_frame_of_reference_of_the_copies(
    root: Path, tmp_path: Path, script: Path
) -> None:
    made = detector(root, tmp_path, command_of(script))
    plain = made.predict_copies(dict.fromkeys(FRAMES))
    copies = made.predict_copies(dict.fromkeys(FRAMES, TURNED), view=2)
    for frame, copy in zip(plain, copies, strict=True):
        moved = TURNED.apply_to_boxes(frame.boxes)
        np.testing.assert_allclose(copy.boxes[:, :3], moved[:, :3], atol=1e-4)
        turned = np.sin(copy.boxes[:, 6] - moved[:, 6])  # apart from half turns
        np.testing.assert_allclose(turned, 0, atol=1e-4)
    assert (tmp_path / "logs" / "round-1-view-2-000000.log").exists()


def test_the_command_gets_paths_as_arguments_and_in_the_environment(
    root: Path, tmp_path: Path
) -> None:
    """Everything that a program in a container needs is below one folder."""
    checkpoint = tmp_path / "a checkpoint"
    checkpoint.touch()
    shell = (
        'test "$CURATE_CLOUDS" = "$1" && test "$CURATE_ROUND" = 7 && test -f "$CURATE_TEACHER" '
        '&& diff "$CURATE_FRAMES" "$2/ImageSets/test.txt" && ls "$2/training/image_2"/*.png '
        '&& test $(ls "$1" | wc -l) = 2 && touch "$3/000001.txt" "$3/000002.txt"'
    )
    command = f"sh {_script(tmp_path, shell)} {{clouds}} {{data}} {{results}} {{teacher}}"
    made = detector(root, tmp_path, command, path=checkpoint, round_number=7)
    found = made.predict_copies(dict.fromkeys(FRAMES[1:3]))
    assert [len(each) for each in found] == [0, 0]


def _script(folder: Path, text: str) -> Path:
    path = folder / "infer.sh"
    path.write_text(text)
    return path


def test_only_points_in_the_camera_view_are_given_on_request(root: Path, tmp_path: Path) -> None:
    """The sizes of the point files show it."""
    script = _script(tmp_path, 'wc -c < "$1/000000.bin"; touch "$2/000000.txt"')
    sizes = []
    for camera_view in (False, True):
        made = detector(
            root, tmp_path, f"sh {script} {{clouds}} {{results}}", camera_view=camera_view
        )
        made.predict_copies({"000000": None})
        log = (tmp_path / "logs" / "round-1-000000.log").read_text()
        sizes.append(int(log.split()[-1]))
    whole = (root / "training" / "velodyne" / "000000.bin").stat().st_size
    assert sizes[0] == whole > sizes[1] > 0


@pytest.mark.parametrize(
    ("mode", "reason"),
    [
        ("exit", "ended with exit code 3 on frame 000000 to 000003: mode exit | CUDA error: | out"),
        ("die", "ended with signal 11 (SIGSEGV) on frame 000000 to 000003: mode die; see "),
        ("hang", "had not finished after 1.5 s (detector.timeout_s) and was ended"),
        ("nothing", "wrote nothing to {results} on frame"),
        ("others", "results for frames that were not requested (000099)"),
        ("twice", "found.csv"),
        ("percent", "set detector.options.results.sigmoid = true if they are logits"),
    ],
)
def test_a_command_that_fails_fails_its_frames_with_one_line(
    root: Path, tmp_path: Path, script: Path, mode: str, reason: str
) -> None:
    """With its last words, and its input and output are kept where the message says."""
    made = detector(root, tmp_path, command_of(script, "''", mode), timeout_s=1.5)
    text = str(failure(made))
    assert reason in text
    kept = tmp_path / "batches" / "failed-round-1-000000"
    assert str(kept) in text
    assert len(list((kept / "data" / "training" / "velodyne").iterdir())) == 4
    assert [each.name for each in (tmp_path / "batches").iterdir()] == [kept.name]


def test_frames_without_a_result_fail_alone(root: Path, tmp_path: Path, script: Path) -> None:
    made = detector(root, tmp_path, command_of(script, "''", "half"))
    found = made.predict_copies(dict.fromkeys(FRAMES))
    assert [isinstance(each, Detections) for each in found] == [True, True, False, False]
    assert str(found[3]).startswith("frame 000003: detector.options.command wrote no result for it")


def test_a_frame_that_cannot_be_read_fails_alone(tmp_path: Path, script: Path) -> None:
    """The others are given to the command, without it in any list, and nothing is kept."""
    write_toy_kitti(tmp_path / "data", frames=3)
    (tmp_path / "data" / "training" / "velodyne" / "000001.bin").write_bytes(b"damaged")
    lists = _script(
        tmp_path,
        f'diff "$3" "$2/../data/ImageSets/test.txt" || exit 1\n{command_of(script)}'.replace(
            "{clouds}", '"$1"'
        ).replace("{results}", '"$2"'),
    )
    made = detector(tmp_path / "data", tmp_path, f"sh {lists} {{clouds}} {{results}} {{frames}}")
    found = made.predict_copies(dict.fromkeys(FRAMES[:3]))
    assert [type(each) for each in found] == [Detections, DataError, Detections]
    assert list((tmp_path / "batches").iterdir()) == []


def test_only_the_last_failures_and_logs_are_kept(
    root: Path, tmp_path: Path, script: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("curate.detectors.command.batch_folders.KEPT_FAILURES", 2)
    monkeypatch.setattr("curate.detectors.command.batch_folders.KEPT_LOGS", 3)
    made = detector(root, tmp_path, command_of(script, "''", "exit"))
    for frame_id in FRAMES:
        failure(made, (frame_id,))
        time.sleep(0.02)
    kept = sorted(each.name for each in (tmp_path / "batches").iterdir())
    assert kept == ["failed-round-1-000002", "failed-round-1-000003"]
    assert len(list((tmp_path / "logs").iterdir())) == 3


def test_folders_of_killed_runs_are_removed_and_those_of_others_stay(tmp_path: Path) -> None:
    """A living process holds a lock on its folder."""
    batches = tmp_path / "batches"
    for name in ("batch-dead", "batch-alive", "batch-new", "batch-old"):
        (batches / name).mkdir(parents=True)
    os.utime(batches / "batch-old", (0, 0))
    for name in ("dead", "alive"):
        (batches / f"batch-{name}" / "lock").touch()
    with (batches / "batch-alive" / "lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        BatchFolders(tmp_path).remove_stale()
    assert sorted(each.name for each in batches.iterdir()) == ["batch-alive", "batch-new"]


def test_a_long_log_is_shortened(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("curate.detectors.command.detector._KEPT_LOG_BYTES", 1000)
    script = _script(tmp_path, "seq 9999; false")
    text = str(failure(detector(root, tmp_path, f"sh {script} {{data}} {{results}}")))
    assert "9997 | 9998 | 9999; see" in text
    log = (tmp_path / "logs" / "round-1-000000.log").read_text()
    assert len(log) < 1500
    assert (log[:5], log[-6:]) == ("$ sh ", "\n9999\n")


@pytest.mark.parametrize(
    ("files", "options", "reason"),
    [
        ({"deep/er/result.csv": 1}, {"path": "**/result.csv"}, None),
        ({"result.csv": 1, "notes.log": 1}, {"path": "result.csv", "kind": "csv"}, None),
        ({"a.csv": 1, "b.csv": 1}, {"path": "*.csv"}, "a.csv, b.csv fits"),
        ({"a.csv": 1}, {"path": "b.csv"}, "nothing fits"),
        ({"result.csv": 1, "log.txt": 1, "plot.png": 1}, {}, None),
        ({"result.csv": 1, "logs/log.json": 1, "lock": 1}, {}, None),
        ({"a.csv": 1, "b.csv": 1}, {}, "contains a.csv, b.csv; set detector.options.results.path"),
    ],
)
def test_results_are_found_by_a_pattern(
    root: Path, tmp_path: Path, files: dict, options: dict, reason: str | None
) -> None:
    """A single file or a folder of files per frame needs none."""
    row = "frame,category,score,x,y,z,length,width,height,yaw\\n0,Car,0.5,9,1,-1,4,2,1.5,0\\n"
    text = "\n".join(
        f'mkdir -p "$(dirname "$2/{name}")" && printf "{row}" > "$2/{name}"' for name in files
    )
    command = f"sh {_script(tmp_path, text)} {{data}} {{results}}"
    [found] = detector(root, tmp_path, command, results=options).predict_copies({"000000": None})
    if reason is None:
        assert found.boxes.tolist() == [[9, 1, -1, 4, 2, 1.5, 0]]
    else:
        assert reason in str(found)


@pytest.mark.parametrize(
    ("files", "reason"),
    [
        ("0.txt 000001.txt metrics.json", None),
        ("data/000000.txt data/000001.txt summary.json", None),
        ("preds/000000.json preds/1.json log.txt", None),
        ("000000.txt 000001.txt log.txt", "not requested (log); the detector must read the frames"),
    ],
)  # fmt: skip
def test_a_file_per_frame_may_have_others_beside_it(
    root: Path, tmp_path: Path, files: str, reason: str | None
) -> None:
    """Those of the other kind are left out; a log with the suffix of the results is explained."""
    nothing = '{"bboxes_3d": [], "scores_3d": [], "labels_3d": [], "box_type_3d": "LiDAR"}'
    text = f"""cd "$2"; mkdir -p data preds
for each in {files}; do case $each in preds/*) echo '{nothing}';; esac > $each; done
"""
    command = f"sh {_script(tmp_path, text)} {{data}} {{results}}"
    made = detector(root, tmp_path, command, results={"classes": ["Car"]})
    found = made.predict_copies(dict.fromkeys(FRAMES[:2]))
    if reason is None:
        assert [len(each) for each in found] == [0, 0]
    else:
        assert reason in str(found[0])


@pytest.mark.parametrize(
    ("command", "options", "reason"),
    [
        ("no-such-program {data} {results}", {}, "no-such-program cannot be started"),
        ("sh infer.sh {data}", {}, "has no {results}"),
        ("sh infer.sh {results}", {}, "has neither {data} nor {clouds}"),
        ("sh infer.sh {cloud} {results}", {}, "unknown placeholder {cloud}; did you mean 'clouds'"),
        ("sh infer.sh {data} {results} {teacher}", {}, "but detector.path, the checkpoint of the"),
        ("sh 'infer.sh", {}, "No closing quotation"),
        ("", {}, "detector.options.command: is empty; write a program and its arguments"),
        ("sh", {"results": {"kinds": "csv"}}, "has no 'kinds'; did you mean 'kind'?"),
        ("sh", {"results": {"rename": {}}}, "has no 'rename'; set detector.rename"),
        ("sh", {"results": {"kind": "cvs"}}, "detector.options.results.kind 'cvs': use one of"),
        ("sh", {"results": {"path": "/x.pkl"}}, "write a name or pattern within {results}"),
        ("sh", {"files": "model.yaml"}, 'write a list, ["model.yaml"]'),
    ],
)
def test_invalid_settings_are_found_before_anything_runs(
    root: Path, tmp_path: Path, command: str, options: dict, reason: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        detector(root, tmp_path, command, **options)
    assert reason in str(caught.value)
    assert_one_line(caught.value)
