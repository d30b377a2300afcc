"""The split for calibration: drawn at init, and kept out of labels and trainings."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from support.pipelines_cli import Curate
from support.rounds import run_workspace
from support.toys import ToySequences, toy_document

from curate.datasets.kitti.dataset import KittiDataset
from curate.errors import ConfigError, LeakageError
from curate.exporters.label_file import read_frames
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import choose_split, initialise


def test_the_other_splits_stay_the_same(toy_kitti: Path) -> None:
    """Only val gets smaller, and no frame is in two splits."""
    dataset = KittiDataset(toy_kitti)
    before = choose_split(dataset, "0.25", "0.4", seed=1)
    after = choose_split(dataset, "0.25", "0.4", seed=1, calibration="0.3")
    assert (after.labeled, after.unlabeled) == (before.labeled, before.unlabeled)
    assert sorted((*after.val, *after.calibration)) == list(before.val)
    assert len(after.calibration) == 1


def test_sequences_are_set_aside_as_a_whole(toy_kitti: Path) -> None:
    """Three frames are a sequence in this data set."""
    for seed in range(4):
        split = choose_split(ToySequences(toy_kitti), "0", "0.75", seed, calibration="0.5")
        sequences = [
            {ToySequences.sequence_name(name) for name in frames}
            for frames in (split.unlabeled, split.val, split.calibration)
        ]
        assert [len(found) for found in sequences] == [1, 1, 1]
        assert len(set.union(*sequences)) == 3


@pytest.mark.parametrize(
    ("val", "calibration", "message"),
    [
        ("", "1.5", "--calibration 1.5: give a share between 0 and 1"),
        ("0", "0.2", "--calibration 0.2: it is a share of the val frames, and there are none"),
        ("", "list", "--calibration .*: frame 000001 is not among the val frames"),
    ],
)
def test_a_wrong_choice_is_one_line(
    toy_kitti: Path, tmp_path: Path, val: str, calibration: str, message: str
) -> None:
    if calibration == "list":
        (tmp_path / "list").write_text("000001\n")
        calibration = str(tmp_path / "list")
    with pytest.raises(ConfigError, match=message):
        choose_split(KittiDataset(toy_kitti), "0.25", val, seed=0, calibration=calibration)


def test_frames_set_aside_are_in_no_label_file(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """Their ground truth is stored, counted by `check`, and refused where it must not be."""
    (tmp_path / "detector.txt").touch()
    (tmp_path / "aside.txt").write_text("000009\n000011\n")
    config = make_config(toy_document(toy_kitti, tmp_path / "detector.txt"), "test")
    aside = str(tmp_path / "aside.txt")
    workspace = initialise(tmp_path / "work", config, "0.25", "", aside)
    assert list(workspace.frames("calibration")) == ["000009", "000011"]
    assert len(workspace.ground_truth("calibration")["000009"].boxes) == 3
    run_workspace(workspace, train=False)
    path = workspace.root / "exports" / "labels.sqlite"
    assert not set(read_frames(path).splits) & {*workspace.frames("val", "calibration")}
    code, out, err = curate("check", "-w", workspace.root)
    assert (code, err) == (0, "")
    assert "2 labeled, 6 unlabeled, 2 val, 2 calibration" in out
    assert "6 objects of X_l, 6 of val, 6 of calibration, 0 of X_u" in out
    (tmp_path / "aside.txt").write_text("000009\n")
    assert "1 removed (000011)" in curate("check", "-w", workspace.root)[2]
    (tmp_path / "aside.txt").write_text("000009\n000011\n")
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE frame SET frame = '000009' WHERE frame = '000000'")
    code, _, err = curate("check", "-w", workspace.root)
    assert code == LeakageError.exit_code
    assert "contains calibration frames: 000009" in err
