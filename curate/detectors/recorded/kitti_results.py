"""KITTI benchmark results: a folder with one FRAME.txt per frame, sixteen fields per line."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from curate.datasets.kitti.labels import KittiObjects, read_objects
from curate.errors import DataError


class KittiResults(Mapping[str, KittiObjects]):
    """The objects of each frame, each read on access.

    An empty file is a frame without detections. Any category name is accepted.

    Args:
        folder: contains the result files: in `data/`, beside which KITTI's own tools write their
            statistics, or directly, or in subfolders such as drives.

    Raises:
        DataError: if there is no result file.
    """

    def __init__(self, folder: Path) -> None:
        home = folder / "data" if any((folder / "data").glob("*.txt")) else folder
        found = [path for path in home.glob("*.txt") if path.name[0] != "."]
        self._paths = {path.stem: path for path in sorted(found)}
        if not found:
            nested = sorted(path for path in home.rglob("*.txt") if path.name[0] != ".")
            self._paths = {path.relative_to(home).as_posix(): path for path in nested}
        if not self._paths:
            raise DataError(f"{folder}: contains no KITTI result files (FRAME.txt)")

    def __getitem__(self, frame_id: str) -> KittiObjects:
        """Return the objects of a frame.

        Raises:
            DataError: if its file is malformed.
        """
        return read_objects(self._paths[frame_id], scored=True, categories=None)

    def __iter__(self) -> Iterator[str]:
        return iter(self._paths)

    def __len__(self) -> int:
        return len(self._paths)
