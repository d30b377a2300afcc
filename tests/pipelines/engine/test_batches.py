"""Stages whose detector takes several frames in one call."""

from pathlib import Path

import pytest
from support.rounds import run_workspace
from support.stored_rows import dump
from support.toys import toy_document, write_toy_kitti

from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a toy data set, and a detector that raises on a frame."""
    home = tmp_path_factory.mktemp("batches")
    write_toy_kitti(home / "kitti", frames=24, val=2)
    (home / "kitti" / "training" / "velodyne" / "000011.bin").write_bytes(b"damaged")
    (home / "detector.txt").write_text("000007")
    return home


def rows(home: Path, name: str, batch_size: int | str, views: int = 1) -> list[tuple]:
    """Return the rows of a workspace in which all stages have run."""
    document = toy_document(home / "kitti", home / "detector.txt")
    detector = {"name": "support.toys:ToyBatchDetector", "batch_size": batch_size}
    document["detector"] |= detector
    document["repredict"] = {"views": views}
    document["run"] = {"executor": "serial"}
    workspace = initialise(home / name, make_config(document, "test"), "0.1", "")
    run_workspace(workspace)
    return dump(workspace)


def test_rows_do_not_depend_on_the_batch_size(home: Path) -> None:
    """Two frames fail alone, one that cannot be read and one on which the detector raises."""
    expected = rows(home, "one", 1)
    assert sum(row[0] == "weight" for row in expected) > 50
    assert rows(home, "default", "auto") == expected
    assert rows(home, "all", 100) == expected


def test_copies_of_several_frames_share_a_call(home: Path) -> None:
    """With more views than frames in a batch, the copies of a frame stay together."""
    expected = rows(home, "single copies", 1, views=3)
    assert rows(home, "two frames", 7, views=3) == expected
