"""The command that checks one frame."""

import json
import pickle
from pathlib import Path

import numpy as np
from support.pipelines_cli import Curate

from curate.datasets.kitti.dataset import KittiDataset


def write_results(path: Path, root: Path, change=None) -> Path:
    """Write OpenPCDet results equal to the ground truth, or a changed copy."""
    dataset = KittiDataset(root)
    entries = []
    for name in dataset.frame_ids():
        truth = dataset.annotations(name)
        boxes = truth.boxes if change is None else change(truth.boxes)
        entry = {"frame_id": name, "name": truth.categories, "boxes_lidar": boxes}
        entries.append({**entry, "score": np.full(len(boxes), 0.9)})
    path.write_bytes(pickle.dumps(entries))
    return path


def begin(curate: Curate, work: Path, root: Path, results: Path) -> None:
    """Create a workspace with recorded results."""
    code, _, err = curate(
        "init", work, "--root", root, "--labeled", "0.25",
        "--detector", "recorded", "--detector-path", results,
    )  # fmt: skip
    assert code == 0, err


def test_a_correct_chain_passes(curate: Curate, tmp_path: Path, toy_kitti: Path) -> None:
    """The only remark is the missing second pass."""
    begin(curate, tmp_path / "w", toy_kitti, write_results(tmp_path / "a.pkl", toy_kitti))
    code, out, err = curate("doctor", "-w", tmp_path / "w")
    assert code == 0, out + err
    assert "suspect  views" in out
    assert "ok       convention" in out


def test_a_wrong_convention_fails(curate: Curate, tmp_path: Path, toy_kitti: Path) -> None:
    """Boxes with their origin at the bottom, also as JSON; an unknown frame is an error."""
    results = write_results(
        tmp_path / "a.pkl", toy_kitti, lambda b: b - b[:, 5:6] * [0, 0, 0.5, 0, 0, 0, 0]
    )
    begin(curate, tmp_path / "w", toy_kitti, results)
    code, out, _ = curate("doctor", "000003", "-w", tmp_path / "w")
    assert (code, out.splitlines()[0]) == (1, "frame 000003")
    assert "z is the bottom of the box" in out
    code, out, _ = curate("doctor", "000003", "--json", "-w", tmp_path / "w")
    assert code == 1
    found = {one["check"]: one["state"] for one in json.loads(out)["findings"]}
    assert found["convention"] == "wrong"
    code, _, err = curate("doctor", "999999", "-w", tmp_path / "w")
    assert code == 2
    assert "frame 999999 is not in the workspace" in err


def test_a_file_that_cannot_be_opened_is_a_finding(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """A pickle that would run code, or a damaged frame."""
    results = write_results(tmp_path / "a.pkl", toy_kitti)
    begin(curate, tmp_path / "w", toy_kitti, results)
    results.write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    code, out, _ = curate("doctor", "-w", tmp_path / "w")
    assert code == 1
    assert "rejected: the pickle imports os.system" in out
