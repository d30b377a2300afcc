"""Point clouds from files of several formats: x, y, z in metres and intensity in [0, 1]."""

import tokenize
import warnings
from pathlib import Path

import numpy as np

from curate.datasets.formats.cloud_formats import read_pcd, read_ply
from curate.datasets.kitti.dataset import check_point_range, read_bytes
from curate.errors import DataError, one_line

# What a damaged header makes numpy raise.
_NPY_DAMAGES = (
    EOFError,
    MemoryError,
    OSError,
    OverflowError,
    RecursionError,
    SyntaxError,
    TypeError,
    ValueError,
    tokenize.TokenError,
)
CLOUD_SUFFIXES = (".bin", ".npy", ".pcd", ".ply")


def read_cloud(path: Path, columns: int = 4, intensity_scale: float = 1.0) -> np.ndarray:
    """Return the (n, 4) float32 points of a file; points that are not finite are left out.

    Args:
        path: .bin of float32, .npy of (n, columns), .pcd or .ply.
        columns: of .bin and .npy: x, y, z, intensity (0 where there are three), others.
        intensity_scale: what full intensity is in the file, e.g. 255; it is clipped there.

    Raises:
        DataError: if the file is missing, damaged or of another format.
    """
    suffix = path.suffix.lower()
    if suffix == ".bin":
        table = _read_bin(path, columns)
    elif suffix == ".npy":
        table = _read_npy(path, columns)
    elif suffix in CLOUD_SUFFIXES:
        read = read_pcd if suffix == ".pcd" else read_ply
        table = read(path, read_bytes(path, "point"))
    else:
        raise DataError(f"{path}: no point file; known are {', '.join(CLOUD_SUFFIXES)}")
    points = np.zeros((len(table), 4), dtype=np.float32)
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is left out
        points[:, : min(table.shape[1], 4)] = table[:, :4]
    points = points[np.isfinite(points).all(axis=1)]
    check_point_range(path, points)
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
    try:
        # Mapped, not read: a header that claims more than the file holds costs no memory, and
        # neither pickles nor archives are taken for arrays.
        with warnings.catch_warnings():
            # Python's of the header's literals, or numpy's that Python 2 wrote them.
            warnings.simplefilter("ignore")
            table = np.lib.format.open_memmap(path, mode="r")
    except FileNotFoundError:
        raise DataError(f"{path}: no such point file") from None
    except _NPY_DAMAGES as error:
        raise DataError(f"{path}: no readable .npy array: {one_line(error, 200)}") from None
    if table.ndim != 2 or table.shape[1] != columns or table.dtype.kind not in "fiu":
        raise DataError(
            f"{path}: {table.dtype} {list(table.shape)}, expected [n, {columns}]; set columns"
        )
    return np.array(table)
