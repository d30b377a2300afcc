"""`curate augment`, a detector that runs elsewhere, and the labels that follow."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from oracles.openpcdet_kitti import Calibration, write_results
from support.paths import ROOT
from support.pipelines_cli import Curate
from support.toys import RayDetector, write_toy_kitti

from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.manifest import Manifest
from curate.detectors.base import Detector
from curate.geometry.projection import in_camera_view
from curate.geometry.similarity import Similarity

Run = Callable[..., Path]


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Return 20 small frames."""
    write_toy_kitti(tmp_path / "kitti", 20)
    return tmp_path / "kitti"


@pytest.fixture
def work(tmp_path: Path, data: Path, curate: Curate) -> Path:
    """Return a workspace over the recorded results of the toy detector, with two views."""
    detect(RayDetector(empty(tmp_path)), data, tmp_path / "results")
    code, _, err = curate(
        "init", tmp_path / "work", "--root", data, "--labeled", "0.2", "--split-by", "frame",
        "--detector", "recorded", "--detector-path", tmp_path / "results",
        "--set", "repredict.views=2", "--set", 'run.priors=["points"]',
    )  # fmt: skip
    assert code == 0, err
    return tmp_path / "work"


def empty(folder: Path) -> Path:
    """Return an empty file, which the toy detector takes for its checkpoint."""
    (folder / "empty").touch()
    return folder / "empty"


def detect(detector: Detector, root: Path, results: Path) -> None:
    """Run a detector in a folder of KITTI's layout as OpenPCDet would: cropped, by its formulas."""
    dataset = KittiDataset(root)
    for name in dataset.frame_ids():
        frame = dataset.read(name)
        calibration = Calibration(dataset.files(name).calibration)
        seen = calibration.in_view(frame.points, frame.image_size)
        found = detector.predict(frame.with_points(frame.points[seen]))
        path = results / f"{name}.txt"
        write_results(path, found.boxes, found.scores, found.categories, calibration)


def set_augmented(work: Path, value: str = "copies") -> None:
    """Write the setting that `curate augment` prints."""
    path = work / "curate.toml"
    lines = path.read_text().splitlines()
    lines = [line for line in lines if not line.startswith(("augmented", "# augmented"))]
    lines.insert(lines.index("[detector]") + 1, f'augmented = "{value}"')
    path.write_text("\n".join(lines) + "\n")


def augment_and_detect(curate: Curate, work: Path, tmp_path: Path, *options: object) -> Path:
    """Write the copies, run the detector on them, and set where the results are."""
    code, _, err = curate("augment", work / "copies", "-w", work, *options)
    assert code == 0, err
    for view in sorted((work / "copies").glob("view-*")):
        detect(RayDetector(empty(tmp_path)), view, view / "results")
    set_augmented(work)
    return work / "copies"


def query(curate: Curate, work: Path, sql: str) -> list[dict]:
    """Return the rows of a query."""
    code, out, err = curate("query", sql, "--json", "-w", work)
    assert code == 0, err
    return json.loads(out)


def test_results_of_the_copies_make_the_labels_count(
    curate: Curate, work: Path, tmp_path: Path
) -> None:
    """From "no label has a weight" to weights, with the setting that the command prints."""
    code, out, err = curate("augment", work / "copies", "-w", work)
    assert code == 0, err
    assert "16 frames written, 0 kept." in out
    assert out.splitlines()[-1] == 'Then set in [detector] of curate.toml: augmented = "copies"'
    augment_and_detect(curate, work, tmp_path)
    code, out, err = curate("run", "-w", work)
    assert code == 0, err
    [row] = query(
        curate, work, "SELECT count(*) AS n, count(loss) AS losses, sum(weight > 0) AS kept "
        "FROM weighted_labels"
    )  # fmt: skip
    assert row["n"] == row["losses"] > 30
    assert row["kept"] > 20
    # The stored views are the similarities that curate would have drawn itself.
    rows = query(curate, work, "SELECT frame, view, flip_y, rotation_rad, scale FROM "
        "reprediction_view JOIN frame ON frame.id = frame_id")  # fmt: skip
    manifest = Manifest.read(work / "copies")
    assert len(rows) == 2 * len(manifest.frames) == 32
    for row in rows:
        expected = manifest.frames[row["frame"]][row["view"]]
        assert expected == Similarity(bool(row["flip_y"]), row["rotation_rad"], row["scale"])


def test_the_detector_elsewhere_gives_the_repredictions_of_the_detector_here(
    curate: Curate, work: Path, data: Path, tmp_path: Path
) -> None:
    """Points and result files are rounded; the boxes agree to a millimetre."""
    augment_and_detect(curate, work, tmp_path)
    assert curate("run", "-w", work)[0] == 0
    here = tmp_path / "here"
    code, _, err = curate(
        "init", here, "--root", data, "--labeled", "0.2", "--split-by", "frame",
        "--detector", "support.toys:RayDetector", "--detector-path", empty(tmp_path),
        "--set", "repredict.views=2", "--set", 'run.priors=["points"]',
        "--set", "train.command='false'",
    )  # fmt: skip
    assert code == 0, err
    for command in ("predict", "repredict"):
        assert curate(command, "-w", here)[0] == 0
    sql = (
        "SELECT frame, view, category, score, x, y, z, length, width, height, yaw FROM reprediction"
        " JOIN frame ON frame.id = frame_id ORDER BY frame, view, category"
    )
    one, other = query(curate, work, sql), query(curate, here, sql)
    assert len(one) == len(other) > 60
    for row, expected in zip(one, other, strict=True):
        for key in ("frame", "view", "category"):
            assert row.pop(key) == expected.pop(key)
        turn = np.angle(np.exp(1j * (row.pop("yaw") - expected.pop("yaw"))))
        assert abs(turn) < 1e-3
        np.testing.assert_allclose(list(row.values()), list(expected.values()), atol=1e-3)


def test_repredictions_are_stale_when_manifest_or_results_change_and_only_then(
    curate: Curate, work: Path, tmp_path: Path
) -> None:
    """Moving the folder changes nothing; a result of one frame does; predictions stay."""

    def waiting() -> dict[str, int]:
        code, out, err = curate("run", "--dry-run", "--json", "-w", work)
        assert code == 0, err
        stages = json.loads(out)["stages"]
        return {each["stage"]: each["frames"] or 0 for each in stages if each["reasons"]}

    copies = augment_and_detect(curate, work, tmp_path)
    assert curate("run", "-w", work)[0] == 0
    assert waiting() == {}
    copies.rename(work / "elsewhere")
    set_augmented(work, "elsewhere")
    os.utime(work / "elsewhere/view-1/results/000001.txt")
    assert waiting() == {}
    changed = next((work / "elsewhere/view-2/results").glob("*.txt"))
    changed.write_text(changed.read_text().replace(".", ".1", 1))
    assert waiting()["repredict"] == 16
    assert "predict" not in waiting()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("seed = 0|seed = 5", "copies of seed 0, expected 5"),
        ("views = 2|views = 1", "copies of views 2, expected 1"),
        ("flip_probability = 0.5|flip_probability = 0.25", "flip_probability 0.5, expected 0.25"),
    ],
)
def test_copies_of_other_settings_are_rejected_at_the_start(
    curate: Curate, work: Path, tmp_path: Path, setting: str, message: str
) -> None:
    """Before predict runs, with the command that writes the right ones."""
    augment_and_detect(curate, work, tmp_path)
    path = work / "curate.toml"
    old, new = setting.split("|")
    path.write_text(path.read_text().replace(old, new))
    for command in ("run", "repredict"):
        code, _, err = curate(command, "-w", work)
        assert code == 3
        assert message in err
        assert "write the copies with `curate augment FOLDER --round 1 --split unlabeled`" in err
        assert err.count("\n") == 1
    # Writing into the same folder does not mix them.
    code, _, err = curate("augment", work / "copies", "-w", work)
    assert code == 3
    assert message in err
    assert "choose an empty folder, or delete this one first" in err


def test_copies_of_another_round_split_or_data_set_are_rejected(
    curate: Curate, work: Path, tmp_path: Path, data: Path
) -> None:
    """{round} stands for the number of the round in both commands."""
    code, out, _ = curate("augment", work / "copies-{round}", "-w", work, "--round", "2")
    assert code == 0
    assert 'augmented = "copies-{round}"' in out
    set_augmented(work, "copies-{round}")
    assert "copies-1/manifest.json: no such file" in curate("run", "-w", work)[2]
    set_augmented(work, "copies-2")
    code, _, err = curate("run", "-w", work)
    assert (code, "copies of round 2, expected 1" in err) == (3, True)
    copies = augment_and_detect(curate, work, tmp_path)
    code, _, err = curate("repredict", "--split", "labeled", "-w", work)
    assert (code, "copies of split unlabeled, expected labeled" in err) == (3, True)
    path = copies / "manifest.json"
    content = json.loads(path.read_text())
    name, views = next(iter(content["frames"].items()))
    del content["frames"][name]
    path.write_text(json.dumps(content))
    code, _, err = curate("run", "-w", work)
    assert (code, f"15 unlabeled frames, but the split has 16; {name} is" in err) == (3, True)
    content["frames"] = {name: [views[0], {**views[1], "scale": 1.0}], **content["frames"]}
    path.write_text(json.dumps(content))
    assert "A of a frame is not the one that curate draws" in curate("run", "-w", work)[2]
    for cloud in (data / "training/velodyne").iterdir():
        cloud.write_bytes(cloud.read_bytes() + cloud.read_bytes()[:16])
    content["frames"][name] = views
    path.write_text(json.dumps(content))
    assert "copies of other frames with the same names" in curate("run", "-w", work)[2]


def test_results_that_do_not_belong_to_the_copies_are_rejected(
    curate: Curate, work: Path, tmp_path: Path, data: Path
) -> None:
    """Those of the frames themselves, boxes that were mapped back, and those of another view."""
    copies = augment_and_detect(curate, work, tmp_path)
    results, other = copies / "view-1/results", copies / "view-2/results"
    results.rename(tmp_path / "right")
    (tmp_path / "results").rename(results)
    (tmp_path / "results").symlink_to(results)
    code, _, err = curate("run", "-w", work)
    assert code == 3
    assert "view-1/results: " in err
    assert "boxes lie where those of the original frames lie" in err
    assert err.count("\n") == 1
    (tmp_path / "results").unlink()
    results.rename(tmp_path / "results")
    other.rename(results)
    (tmp_path / "right").rename(other)
    code, _, err = curate("run", "-w", work)
    assert code == 3
    assert "view-1/results: these are results of view-2: " in err


def test_headings_in_another_convention_are_found(
    curate: Curate, work: Path, tmp_path: Path, data: Path
) -> None:
    """A tool in the camera's frame writes rotation_y by the calibration of the copy."""
    copies = augment_and_detect(curate, work, tmp_path)
    detector = RayDetector(empty(tmp_path))
    detect(detector, data, tmp_path / "results")
    manifest = Manifest.read(copies)
    for view in (0, 1):
        home = copies / f"view-{view + 1}"
        detect(detector, home, home / "results")
        for name, similarities in manifest.frames.items():
            path = home / f"results/{name}.txt"
            rows = [line.split() for line in path.read_text().splitlines()]
            for row in rows:
                row[14] = str(float(row[14]) + similarities[view].rotation_rad)
            path.write_text("".join(f"{' '.join(row)}\n" for row in rows))
    code, _, err = curate("run", "-w", work)
    assert code == 3
    assert 'set detector.options.rotation_y = "calibration"' in err
    path = work / "curate.toml"
    old, new = "options = {}", 'options = {rotation_y = "calibration"}'
    head, section, rest = path.read_text().partition("[detector]")
    assert old in rest
    path.write_text(head + section + rest.replace(old, new, 1))
    code, _, err = curate("run", "-w", work)
    assert code == 0, err


def test_messages_name_the_results_of_the_view_that_is_wrong(
    curate: Curate, work: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Frame names, category names, and results without any box; those of the frames are right."""
    results = augment_and_detect(curate, work, tmp_path) / "view-1/results"
    right = {path.name: path.read_text() for path in results.iterdir()}
    for path in results.iterdir():
        path.rename(results / f"x{path.name}")
    code, _, err = curate("run", "-w", work)
    assert (code, f"{results}: results for frames that do not exist (x0" in err) == (3, True)
    for path in results.iterdir():
        path.unlink()
    for name, text in right.items():
        (results / name).write_text(text.replace("Pedestrian", "pedestrian"))
    code, _, err = curate("run", "-w", work)
    assert (code, f"the results {results} have pedestrian, but" in err) == (2, True)
    for name in right:
        (results / name).write_text("")
    assert curate("repredict", "-w", work)[0] == 0
    assert f"{results}: no boxes in 16 copies, but 48 in their frames" in caplog.text


def test_missing_results_are_counted_at_the_start(
    curate: Curate, work: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """They fail their frames only."""
    copies = augment_and_detect(curate, work, tmp_path)
    missing = sorted((copies / "view-2/results").glob("*.txt"))[:2]
    for path in missing:
        path.unlink()
    code, out, _ = curate("run", "-w", work)
    assert code == 8
    assert f"no results for 2 of 16 copies ({missing[0].stem}, {missing[1].stem})" in caplog.text
    assert "14 frames done" in out
    assert "2 failed" in out


def test_a_detector_that_predicts_itself_needs_no_copies(
    curate: Curate, tmp_path: Path, data: Path
) -> None:
    """The setting would have no effect."""
    code, _, err = curate(
        "init", tmp_path / "work", "--root", data, "--labeled", "0.2", "--split-by", "frame",
        "--set", "detector.augmented=copies",
    )  # fmt: skip
    assert code == 2
    assert "detector.augmented is for recorded results, but detector 'pillars' predicts" in err


def test_doctor_checks_the_results_of_the_copies(
    curate: Curate, work: Path, tmp_path: Path
) -> None:
    """And says that a frame of another split has none."""
    augment_and_detect(curate, work, tmp_path)
    _, out, _ = curate("doctor", "-w", work)
    assert "2 recorded augmented copies of this frame" in out
    labeled = query(curate, work, "SELECT frame FROM frame WHERE split = 'labeled' LIMIT 1")
    _, out, _ = curate("doctor", labeled[0]["frame"], "-w", work)
    assert "the augmented copies are those of another split" in out


def tree(folder: Path) -> dict[str, bytes]:
    """Return the content of all visible files."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_shards_are_disjoint_and_add_up(curate: Curate, work: Path) -> None:
    """In any order, with any workers; each writes the same manifest and lists."""
    assert curate("augment", work / "whole", "-w", work, "--workers", "2")[0] == 0
    counts = []
    for shard in ("3/3", "1/3", "2/3"):
        code, out, err = curate("augment", work / "parts", "-w", work, "--shard", shard, "--json")
        assert code == 0, err
        result = json.loads(out)
        assert result["kept"] == 0
        counts.append(result["written"])
        if len(counts) == 1:
            first = (work / "parts/manifest.json").read_bytes()
    assert counts == [5, 6, 5]
    assert tree(work / "parts") == tree(work / "whole")
    assert (work / "parts/manifest.json").read_bytes() == first
    code, out, _ = curate("augment", work / "parts", "-w", work, "--json")
    assert (json.loads(out)["written"], json.loads(out)["kept"]) == (0, 16)
    for wrong in ("0/3", "4/3", "3", "a/b", "1/0"):
        code, _, err = curate("augment", work / "parts", "-w", work, "--shard", wrong)
        assert code == 2
        assert f"--shard {wrong}: write the number of the part and of all parts" in err


@pytest.mark.parametrize("split", ["labeled", "val"])
def test_other_splits(curate: Curate, work: Path, split: str) -> None:
    """Their labels are not copied; a split without frames is an error."""
    code, out, err = curate("augment", work / "copies", "-w", work, "--split", split)
    if split == "val":
        assert (code, "the workspace has no val frames" in err) == (2, True)
        return
    assert "4 frames written" in out
    assert not list((work / "copies").rglob("label_2"))


def test_every_split_has_copies_of_its_own(curate: Curate, work: Path, tmp_path: Path) -> None:
    """{split} in the command and in the setting: results of one split leave those of another."""
    for split in ("unlabeled", "labeled"):
        code, out, err = curate("augment", work / "{split}/{round}", "-w", work, "--split", split)
        assert code == 0, err
        assert out.endswith('augmented = "{split}/{round}"\n')
        for view in (work / split / "1").glob("view-*"):
            detect(RayDetector(empty(tmp_path)), view, view / "results")
    set_augmented(work, "{split}/{round}")
    for split in ("unlabeled", "labeled"):
        for command in ("predict", "repredict"):
            code, _, err = curate(command, "--split", split, "-w", work)
            assert code == 0, err
    for split in ("unlabeled", "labeled"):
        out = curate("repredict", "--split", split, "--dry-run", "--json", "-w", work)[1]
        assert [each["frames"] for each in json.loads(out)["stages"]] == [0]
    name = query(curate, work, "SELECT frame FROM frame WHERE split = 'labeled'")[0]["frame"]
    code, out, _ = curate("doctor", name, "-w", work)
    assert "2 recorded augmented copies of this frame" in out
    set_augmented(work, "{splits}")
    for command in (["run"], ["doctor"]):
        out = "".join(map(str, curate(*command, "-w", work)))
        assert "{splits}: unknown placeholder {splits}; did you mean 'split'?" in out


def test_a_folder_in_which_copies_cannot_be_is_found_at_the_start(
    curate: Curate, work: Path, data: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for folder, message in {
        data / "training/copies": f"is in the data set {data}",
        tmp_path / "{policy}": "unknown placeholder {policy}; it has {round} and {split}",
        tmp_path / "file/copies/1": f"{tmp_path}/file is not a folder",
        tmp_path / "link": f"{tmp_path}/link is not a folder",
    }.items():
        for more in ([], ["--dry-run"]):
            code, _, err = curate("augment", folder, "-w", work, *more)
            assert (code, err.count("\n")) == (2, 1)
            assert message in err
    assert not (data / "training/copies").exists()


def test_what_would_be_written(curate: Curate, work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A dry run writes nothing; a disk that is too small is found before the first file."""
    code, out, _ = curate("augment", work / "copies", "-w", work, "--dry-run")
    assert (code, "copies of 16 of 16 unlabeled frames (views: 2)" in out) == (0, True)
    code, out, _ = curate("augment", work / "copies", "-w", work, "--dry-run", "--json")
    found = json.loads(out)
    assert (found["waiting"], found["frames"]) == (16, 16)
    assert found["bytes"] > 32 * 400 * 16

    class Usage:
        free = 1000

    monkeypatch.setattr("shutil.disk_usage", lambda _: Usage)
    code, _, err = curate("augment", work / "copies", "-w", work)
    assert code == 3
    assert "but the disk has only 0.0 GB left; choose another disk" in err
    assert not (work / "copies").exists()


def test_a_folder_with_other_files_is_left_alone(curate: Curate, work: Path) -> None:
    """A wrong path must not be filled with copies."""
    (work / "copies").mkdir()
    (work / "copies/thesis.tex").touch()
    code, _, err = curate("augment", work / "copies", "-w", work)
    assert code == 3
    assert "contains files, but no manifest.json; choose an empty folder" in err


def test_a_damaged_frame_fails_alone(curate: Curate, work: Path, data: Path) -> None:
    """The others are written; after the repair the same command writes the rest."""
    name = query(curate, work, "SELECT frame FROM frame WHERE split = 'unlabeled'")[3]["frame"]
    cloud = data / f"training/velodyne/{name}.bin"
    content = cloud.read_bytes()
    cloud.write_bytes(content[:-5])
    code, out, err = curate("augment", work / "copies", "-w", work)
    assert code == 8
    assert "15 frames written" in out
    assert f"{name}.bin" in out
    assert "1 frames have no copies; fix their files and rerun" in err
    cloud.write_bytes(content)
    assert "1 frames written, 15 kept" in curate("augment", work / "copies", "-w", work)[1]


def test_a_killed_run_leaves_no_half_written_copy(curate: Curate, work: Path) -> None:
    """Every file that is there is whole, and the rest follows."""
    command = [sys.executable, "-m", "curate", "augment", str(work / "copies"), "-w", str(work)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
    until = time.monotonic() + 60
    while not list((work / "copies").glob("view-*/training/velodyne/*.bin")):
        assert time.monotonic() < until
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = {
        name: content
        for name, content in tree(work / "copies").items()
        if not name.endswith(".partial")
    }
    assert curate("augment", work / "copies", "-w", work)[0] == 0
    assert curate("augment", work / "whole", "-w", work)[0] == 0
    after = tree(work / "whole")
    assert all(after[name] == content for name, content in before.items())
    assert after.items() <= tree(work / "copies").items()


def test_copies_for_detectors_that_do_not_crop(curate: Curate, work: Path) -> None:
    """Only the points that the camera sees; a folder holds one kind of copies."""
    assert curate("augment", work / "copies", "-w", work, "--camera-view")[0] == 0
    dataset = KittiDataset(work / "copies/view-1")
    for name in dataset.frame_ids():
        frame = dataset.read(name)
        assert len(frame.points) - in_camera_view(frame).sum() <= 1  # a point on the border
    code, _, err = curate("augment", work / "copies", "-w", work)
    assert code == 3
    assert "copies with --camera-view, requested without it" in err
