"""Point clouds from files of several formats: x, y, z in metres and intensity in [0, 1]."""

from pathlib import Path

import numpy as np

from curate.datasets.kitti import read_bytes
from curate.errors import DataError

CLOUD_SUFFIXES = (".bin", ".npy", ".pcd", ".ply")


def read_cloud(path: Path, columns: int = 4, intensity_scale: float = 1.0) -> np.ndarray:
    """The (n, 4) float32 points of a file; points that are not finite are left out.

    Args:
        path: .bin of float32, .npy of (n, columns), .pcd or .ply.
        columns: of .bin and .npy: x, y, z, intensity (0 where there are three), others.
        intensity_scale: what full intensity is in the file, e.g. 255; it is clipped there.

    Raises:
        DataError: the file is missing, damaged or of another format.
    """
    suffix = path.suffix.lower()
    if suffix == ".bin":
        table = _read_bin(path, columns)
    elif suffix == ".npy":
        table = _read_npy(path, columns)
    elif suffix in CLOUD_SUFFIXES:
        table = _read_with_open3d(path)
    else:
        raise DataError(f"{path}: no point file; known are {', '.join(CLOUD_SUFFIXES)}")
    points = np.zeros((len(table), 4), dtype=np.float32)
    points[:, : min(table.shape[1], 4)] = table[:, :4]
    points = points[np.isfinite(points).all(axis=1)]
    points[:, 3] = np.clip(points[:, 3] / intensity_scale, 0, 1)
    return points


def _read_bin(path: Path, columns: int) -> np.ndarray:
    content = read_bytes(path, "point")
    if len(content) % (4 * columns):
        raise DataError(
            f"{path}: {len(content)} bytes are no rows of {columns} float32; set columns"
        )
    return np.frombuffer(content, dtype="<f4").reshape(-1, columns)


def _read_npy(path: Path, columns: int) -> np.ndarray:
    read_bytes(path, "point")
    try:
        table = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        words = " ".join(str(error).split())
        raise DataError(f"{path}: no readable .npy array: {words}") from None
    if table.ndim != 2 or table.shape[1] != columns or table.dtype.kind not in "fiu":
        raise DataError(
            f"{path}: {table.dtype} {list(table.shape)}, expected [n, {columns}]; set columns"
        )
    return np.asarray(table)


def _read_with_open3d(path: Path) -> np.ndarray:
    from curate.datasets.open3d_loader import load

    read_bytes(path, "point")
    open3d = load()
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.t.io.read_point_cloud(str(path))
    if "positions" not in cloud.point:
        raise DataError(f"{path}: no readable {path.suffix} point cloud, or one without points")
    places = cloud.point["positions"].numpy()
    if "intensity" not in cloud.point:
        return np.asarray(places)
    return np.column_stack([places, cloud.point["intensity"].numpy().reshape(-1)])
