"""Data that tests share: real KITTI frames where they are, and small handmade ones otherwise."""

import os
from pathlib import Path

import pytest
from toys import write_toy_kitti

ROOT = Path(__file__).parent.parent


def _shared(variable: str, name: str) -> Path:
    path = Path(os.environ.get(variable, ROOT.parent / "shared" / name))
    if not path.is_dir():
        pytest.skip(f"{variable} is not set and ../shared/{name} is not there")
    return path


@pytest.fixture(scope="session")
def kitti_root() -> Path:
    """Real KITTI frames with recorded detections and a segmentation model."""
    return _shared("CURATE_KITTI", "kitti")


@pytest.fixture(scope="session")
def kitti_eval_root() -> Path:
    """Made-up labels and results with the AP that the official devkit prints for them."""
    return _shared("CURATE_KITTI_EVAL", "kitti_eval")


@pytest.fixture
def toy_kitti(tmp_path: Path) -> Path:
    """Twelve small frames in KITTI's layout, eight of them for training."""
    root = tmp_path / "kitti"
    write_toy_kitti(root, frames=12, val=4)
    return root
