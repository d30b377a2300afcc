"""Every kind of data leak is produced and must be detected before any training."""

import csv
import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from support.pipelines_cli import Curate
from support.rounds import run_workspace
from support.toys import toy_document, write_toy_kitti

from curate.datasets.kitti.dataset import KittiDataset
from curate.errors import DataError, LeakageError
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise

# A fast training: a program that writes a file.
TRAINER = 'python3 -c \'import os; open(os.environ["CURATE_OUTPUT"], "w").write("student")\''


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with toy frames and a workspace over them that can be copied."""
    home = tmp_path_factory.mktemp("leaks")
    write_toy_kitti(home / "kitti", frames=12, val=4)
    (home / "detector.txt").touch()
    document = toy_document(home / "kitti", home / "detector.txt")
    workspace = initialise(home / "work", make_config(document, "test"), "0.25", "")
    for report in run_workspace(workspace, train=False):
        assert report.failed == 0
    workspace.database.close()
    settings = home / "work" / "curate.toml"
    settings.write_text(settings.read_text().replace(str(home), ".."))
    return home


@pytest.fixture
def work(exported: Path, tmp_path: Path) -> Path:
    """Return a workspace of 2 labeled, 6 unlabeled and 4 val frames, exported once."""
    shutil.copytree(exported, tmp_path, dirs_exist_ok=True)
    return tmp_path / "work"


@pytest.fixture
def toy_kitti(exported: Path, tmp_path: Path) -> Path:
    """Return the frames of the workspace."""
    shutil.copytree(exported / "kitti", tmp_path / "kitti", dirs_exist_ok=True)
    return tmp_path / "kitti"


def change(path: Path, *statements: str) -> None:
    """Change a database as someone with the sqlite3 shell would."""
    with closing(sqlite3.connect(path)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()


def frames(work: Path, split: str) -> list[str]:
    """Return the frames of a split."""
    with closing(sqlite3.connect(work / "curate.db")) as connection:
        query = "SELECT frame FROM frame WHERE split = ? ORDER BY frame"
        return [row[0] for row in connection.execute(query, (split,))]


def assert_caught(curate: Curate, work: Path, *words: str, started: bool = True) -> None:
    """Check that `check` reports the leak, and that neither export nor training starts."""
    code, out, err = curate("check", "-w", work)
    assert code == LeakageError.exit_code, out
    assert "FAIL" in out
    assert err.count("\n") == 1
    assert all(word in err for word in words), err
    for command in (
        ["export"],
        ["export", "--format", "csv"],
        ["train-round", "--command", TRAINER],
    ):
        code, _, err = curate(*command, "-w", work)
        if started:
            assert code == LeakageError.exit_code, (command, err)
            assert err.count("\n") == 1
            assert all(word in err for word in words), err
    assert started is False or not list((work / "checkpoints").iterdir())


def test_a_clean_workspace_passes(curate: Curate, work: Path) -> None:
    """Every rule is listed with its numbers; then the training runs."""
    code, out, err = curate("check", "-w", work)
    assert (code, err) == (0, "")
    assert "FAIL" not in out
    assert "2 labeled, 6 unlabeled, 4 val" in out
    assert "6 objects of X_l, 12 of val, 0 of X_u" in out
    assert "18 predictions compared" in out
    code, out, _ = curate("check", "--json", "-w", work)
    assert code == 0
    assert all(finding["passed"] for finding in json.loads(out))
    code, _, err = curate("train-round", "--command", TRAINER, "-w", work)
    assert code == 0, err


def test_a_changed_list_of_the_dataset(curate: Curate, work: Path, toy_kitti: Path) -> None:
    """A val frame that moved into train.txt is reported."""
    val = toy_kitti / "ImageSets" / "val.txt"
    names = val.read_text().split()
    val.write_text("\n".join(names[1:]) + "\n")
    with (toy_kitti / "ImageSets" / "train.txt").open("a") as file:
        file.write(f"{names[0]}\n")
    assert_caught(curate, work, "1 added (000008)", "1 removed (000008)", "curate init")


def test_a_changed_list_passed_to_init(curate: Curate, tmp_path: Path, toy_kitti: Path) -> None:
    (tmp_path / "detector.txt").touch()
    listed = tmp_path / "ids.txt"
    listed.write_text("000001\n000003\n")
    curate(
        "init", tmp_path / "work", "--root", toy_kitti, "--labeled", listed,
        "--detector", "support.toys:ToyDetector", "--detector-path", tmp_path / "detector.txt",
    )  # fmt: skip
    listed.write_text("000001\n000003\n000004\n")
    code, _, err = curate("check", "-w", tmp_path / "work")
    assert code == LeakageError.exit_code
    assert "ids.txt: 1 added (000004)" in err
    listed.unlink()
    assert curate("check", "-w", tmp_path / "work")[0] == 0


def test_a_changed_split_in_the_database(curate: Curate, work: Path) -> None:
    """A val frame declared unlabeled, or a frame that was removed."""
    moved = frames(work, "val")[0]
    change(
        work / "curate.db",
        "PRAGMA foreign_keys = OFF",
        f"DELETE FROM ground_truth WHERE frame_id = (SELECT id FROM frame WHERE frame = '{moved}')",
        f"UPDATE frame SET split = 'unlabeled', label_path = NULL WHERE frame = '{moved}'",
    )
    assert_caught(curate, work, f"val: 1 removed ({moved})", f"unlabeled: 1 added ({moved})")


def test_a_changed_record_of_the_splits(curate: Curate, work: Path) -> None:
    """The record is protected too."""
    change(
        work / "curate.db", "UPDATE split_list SET names = names || '999999\n' WHERE name = 'val'"
    )
    assert_caught(curate, work, "does not match its hash")
    change(work / "curate.db", "DELETE FROM split_list")
    assert_caught(curate, work, "the record is missing")


def test_ground_truth_of_an_unlabeled_frame_in_the_database(curate: Curate, work: Path) -> None:
    """With trigger and foreign keys switched off."""
    leaked = frames(work, "unlabeled")[2]
    change(
        work / "curate.db",
        "PRAGMA foreign_keys = OFF",
        "DROP TRIGGER ground_truth_never_unlabeled",
        f"UPDATE ground_truth SET frame_id = (SELECT id FROM frame WHERE frame = '{leaked}') "
        "WHERE split = 'labeled'"
        " AND frame_id = (SELECT min(frame_id) FROM ground_truth WHERE split = 'labeled')",
    )
    assert_caught(curate, work, "3 rows of ground_truth", leaked)


@pytest.mark.parametrize("split", ["val", "unlabeled"])
def test_a_frame_inserted_into_the_label_file(curate: Curate, work: Path, split: str) -> None:
    """As a labeled frame with its ground truth: object bank and trainer would use both."""
    leaked = frames(work, split)[0]
    change(
        work / "exports" / "round-01-pspsl.sqlite",
        f"DELETE FROM label WHERE frame = '{leaked}'",
        f"INSERT OR REPLACE INTO frame VALUES ('{leaked}', 'labeled', 'p', 'i', 'c')",
        "INSERT INTO ground_truth (frame, k, category, x, y, z, length, width, height, yaw, "
        f"truncated, occluded) VALUES ('{leaked}', 0, 'Car', 9, 0, 0, 4, 2, 1.5, 0, 0, 0)",
    )
    code, out, err = curate("check", "-w", work)
    assert code == LeakageError.exit_code
    assert leaked in err
    assert "the object bank is from X_l" in out
    assert f"objects of frames outside X_l: {leaked}" in out
    for command in (["export"], ["train-round", "--command", TRAINER]):
        code, _, err = curate(*command, "-w", work)
        assert code == LeakageError.exit_code
        assert leaked in err
    (work / "exports" / "round-01-pspsl.sqlite").unlink()
    assert curate("export", "-w", work)[0] == 0
    assert curate("check", "-w", work)[0] == 0


def test_labels_changed_after_the_export(curate: Curate, work: Path) -> None:
    """A changed box and weight: only the hash shows it."""
    change(work / "exports" / "round-01-pspsl.sqlite", "UPDATE label SET weight = 1, x = x + 0.25")
    code, _, err = curate("train-round", "--command", TRAINER, "-w", work)
    assert code == LeakageError.exit_code
    assert "round-01-pspsl.sqlite was changed after it was exported" in err
    assert curate("check", "-w", work)[0] == LeakageError.exit_code


def test_a_damaged_label_file(curate: Curate, work: Path) -> None:
    """Half a file is not a leak, but cannot be used for training."""
    path = work / "exports" / "round-01-pspsl.sqlite"
    path.write_bytes(path.read_bytes()[:5000])
    code, _, err = curate("train-round", "--command", TRAINER, "-w", work)
    assert code == DataError.exit_code, err
    # The export is up to date, but damaged.
    assert "delete it and export it again" in err
    assert curate("check", "-w", work)[0] == LeakageError.exit_code
    path.unlink()
    assert curate("export", "-w", work)[0] == 0
    assert curate("check", "-w", work)[0] == 0


@pytest.mark.parametrize("score", [1.0, 0.7])
def test_label_files_used_as_detections(
    curate: Curate, tmp_path: Path, toy_kitti: Path, score: float
) -> None:
    """A record created from the label files of X_u."""
    dataset = KittiDataset(toy_kitti)
    record = tmp_path / "detections.csv"
    columns = "frame view flip_y rotation_rad scale category score x y z length width height yaw"
    with record.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns.split())
        for frame in dataset.frame_ids():
            truth = dataset.annotations(frame)
            for box, category in zip(truth.boxes.tolist(), truth.categories, strict=True):
                rounded = [round(number, 5) for number in box]
                writer.writerow([frame, 0, 0, 0, 1, category, score, *rounded])
    work = tmp_path / "work"
    code, _, err = curate(
        "init", work, "--root", toy_kitti, "--labeled", "0.25",
        "--detector", "recorded", "--detector-path", record,
    )  # fmt: skip
    assert code == 0, err
    assert curate("predict", "-w", work)[0] == 0
    assert_caught(curate, work, "18 predictions equal labels")


def test_an_object_bank_of_unlabeled_frames(curate: Curate, work: Path) -> None:
    """Exported for another trainer, with objects of X_u added."""
    code, _, err = curate("export", "--format", "openpcdet", "-w", work)
    assert code == 0, err
    assert curate("check", "-w", work)[0] == 0
    bank = work / "exports" / "round-01-pspsl-openpcdet" / "gt_database"
    leaked = frames(work, "unlabeled")[1]
    (bank / f"{leaked}_Person_sitting_0.bin").write_bytes(bytes(64))
    assert_caught(curate, work, f"outside X_l: {leaked}", started=False)


def test_the_same_recording_under_two_names(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """A labeled frame has the points of a val frame, and one image is used twice."""
    home = toy_kitti / "training"
    shutil.copy(home / "velodyne" / "000002.bin", home / "velodyne" / "000009.bin")
    shutil.copy(home / "image_2" / "000003.png", home / "image_2" / "000010.png")
    (tmp_path / "detector.txt").touch()
    work = tmp_path / "work"
    curate(
        "init", work, "--root", toy_kitti, "--labeled", "0.25",
        "--detector", "support.toys:ToyDetector", "--detector-path", tmp_path / "detector.txt",
    )  # fmt: skip
    for _ in range(2):  # the second time from stored hashes
        code, _, err = curate("check", "-w", work)
        assert code == LeakageError.exit_code
        assert "2 pairs are identical" in err
        assert "000002 and val 000009 (points)" in err
        assert "000003 and val 000010 (image)" in err
    write_toy_kitti(toy_kitti, frames=12, val=4)
    assert curate("check", "-w", work)[0] == 0


def test_pretraining_is_checked_too(curate: Curate, tmp_path: Path, toy_kitti: Path) -> None:
    """The first teacher is trained on X_l as init chose it, or not at all."""
    work = tmp_path / "work"
    assert curate("init", work, "--root", toy_kitti, "--labeled", "0.25")[0] == 0
    (toy_kitti / "ImageSets" / "val.txt").write_text("000011\n")
    for command in ("pretrain", "run"):
        code, _, err = curate(command, "-w", work)
        assert code == LeakageError.exit_code, err
        assert "the data set's val: 3 removed" in err
