"""Results as KITTI's benchmark takes them: a folder with FRAME.txt, sixteen fields per line."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from curate.datasets.kitti.labels import KittiObjects, read_objects
from curate.errors import DataError


class KittiResults(Mapping[str, KittiObjects]):
    """The objects of each frame, read when they are asked for, so that a bad file fails alone.

    An empty file is a frame without detections. Names of categories are free.

    Args:
        folder: it holds the result files itself, or in `data/` as KITTI's own tools leave them.

    Raises:
        DataError: there is no result file.
    """

    def __init__(self, folder: Path) -> None:
        homes = (folder, folder / "data")
        found = [[path for path in home.glob("*.txt") if path.name[0] != "."] for home in homes]
        self._paths = {path.stem: path for path in sorted(found[0] or found[1])}
        if not self._paths:
            raise DataError(f"{folder}: holds no KITTI result files (FRAME.txt)")

    def __getitem__(self, frame_id: str) -> KittiObjects:
        """Return the objects of a frame; DataError where its file is malformed."""
        return read_objects(self._paths[frame_id], scored=True, categories=None)

    def __iter__(self) -> Iterator[str]:
        return iter(self._paths)

    def __len__(self) -> int:
        return len(self._paths)
