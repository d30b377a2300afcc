"""Small frames that the contract tests run extensions on."""

import pytest
from support.toys import write_toy_kitti

from curate.datasets.kitti.dataset import KittiDataset
from curate.frames import Frame


@pytest.fixture(scope="session")
def frames(tmp_path_factory: pytest.TempPathFactory) -> tuple[Frame, ...]:
    """Return three frames with points and image."""
    root = tmp_path_factory.mktemp("frames")
    write_toy_kitti(root, frames=3)
    dataset = KittiDataset(root)
    return tuple(dataset.read(name, image=True) for name in dataset.frame_ids())
