"""Splits of datasets with sequences: KITTI raw, KITTI with its mapping, folders."""

import shutil
from pathlib import Path

import pytest
from support.dataset_layouts import DRIVE, write_toy_raw
from support.pipelines_cli import Curate
from support.toys import write_toy_kitti

from curate.datasets.kitti.dataset import KittiDataset
from curate.datasets.kitti.raw import KittiRawDataset
from curate.errors import ConfigError, LeakageError
from pipelines.workspace.setup import choose_split


@pytest.fixture
def drives(tmp_path: Path) -> Path:
    """Return five drives of four frames."""
    write_toy_raw(tmp_path / "raw")
    day = tmp_path / "raw" / "2011_09_26"
    for number in range(2, 6):
        shutil.copytree(day / DRIVE, day / DRIVE.replace("0001", f"000{number}"))
        for kind, ending in (("velodyne_points", "bin"), ("image_02", "png")):
            for path in (day / DRIVE.replace("0001", f"000{number}") / kind / "data").iterdir():
                assert path.suffix == f".{ending}"
                path.write_bytes(path.read_bytes() + bytes(16 * number))
    shutil.rmtree(tmp_path / "raw" / "made")
    return tmp_path / "raw"


def test_a_share_of_a_raw_dataset_consists_of_whole_drives(
    curate: Curate, drives: Path, tmp_path: Path
) -> None:
    """A labeled drive, a val drive, three unlabeled ones; `check` counts them."""
    work = tmp_path / "work"
    code, out, err = curate(
        "init", work, "--dataset", "kitti-raw", "--root", drives,
        "--labeled", "0.25", "--val", "0.2",
    )  # fmt: skip
    assert (code, err) == (0, "")
    assert "4 labeled, 12 unlabeled and 4 val frames" in out
    code, out, err = curate("check", "-w", work)
    assert (code, err) == (0, ""), out
    assert "5 sequences, each in one split" in out
    for seed in range(5):
        split = choose_split(KittiRawDataset(drives), "0.2", "0.2", seed)
        of = [
            {name[:25] for name in frames} for frames in (split.labeled, split.unlabeled, split.val)
        ]
        assert [len(found) for found in of] == [1, 3, 1]
        assert len(set.union(*of)) == 5


def test_splitting_by_frame_gives_a_warning(
    curate: Curate, drives: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The rule is then waived, and `check` shows the numbers."""
    work = tmp_path / "work"
    code, _, err = curate(
        "init", work, "--dataset", "kitti-raw", "--root", drives, "--labeled", "0.5",
        "--split-by", "frame",
    )  # fmt: skip
    assert code == 0, err
    assert "near-duplicate frames of one sequence" in caplog.text
    code, out, _ = curate("check", "-w", work)
    assert code in (0, LeakageError.exit_code)
    assert "waived by dataset.split_by = frame: 5 sequences" in out
    assert "in both labeled and unlabeled" in out
    settings = work / "curate.toml"
    settings.write_text(settings.read_text().replace('"frame"', '"sequence"'))
    code, _, err = curate("check", "-w", work)
    assert code == LeakageError.exit_code
    assert "each sequence is in one split" in err


def test_a_list_that_cuts_a_drive_is_rejected(curate: Curate, drives: Path, tmp_path: Path) -> None:
    """The error contains the drive and the option."""
    (tmp_path / "ids.txt").write_text(f"{DRIVE}_0000000000\n")
    arguments = ("init", tmp_path / "w", "--dataset", "kitti-raw", "--root", drives, "--labeled")
    code, _, err = curate(*arguments, tmp_path / "ids.txt")
    assert code == LeakageError.exit_code
    assert DRIVE in err
    assert "--split-by frame" in err


def test_a_single_drive_cannot_be_split(curate: Curate, tmp_path: Path) -> None:
    """A share of it would be all or nothing."""
    write_toy_raw(tmp_path / "raw")
    code, _, err = curate(
        "init", tmp_path / "w", "--dataset", "kitti-raw", "--root", tmp_path / "raw",
        "--labeled", "0.25",
    )  # fmt: skip
    assert code == ConfigError.exit_code
    assert "all 4 frames belong to sequence" in err


def test_kitti_object_reads_its_drives_from_the_mapping(tmp_path: Path) -> None:
    """Of the development kit, if it is in the root."""
    write_toy_kitti(tmp_path, frames=6, val=2)
    home = tmp_path / "devkit_object" / "mapping"
    home.mkdir(parents=True)
    names = ["a", "b", "a", "b", "c", "c"]
    lines = [f"2011_09_26 {name} 000000000{i}" for i, name in enumerate(names)]
    (home / "train_mapping.txt").write_text("\n".join(reversed(lines)))
    (home / "train_rand.txt").write_text("6,5,4,3,2,1")
    dataset = KittiDataset(tmp_path)
    assert [dataset.sequence_of(f"00000{i}") for i in range(6)] == names
    split = choose_split(dataset, "0.5", "", 0)
    assert set(split.labeled) in ({"000000", "000002"}, {"000001", "000003"})
    (tmp_path / "ImageSets" / "train.txt").write_text("000000\n000001\n000002\n000004\n")
    (tmp_path / "ImageSets" / "val.txt").write_text("000003\n000005\n")
    with pytest.raises(LeakageError, match="have frames in both labeled and val"):
        choose_split(KittiDataset(tmp_path), "0.5", "", 2)
