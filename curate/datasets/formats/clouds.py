"""Reader of point clouds in several file formats: x, y, z in metres and intensity in [0, 1]."""

import tokenize
import warnings
from pathlib import Path

import numpy as np

from curate.datasets.formats.cloud_formats import read_pcd, read_ply
from curate.datasets.kitti.dataset import check_point_range, read_bytes
from curate.errors import DataError, one_line

# The errors that numpy raises for a damaged .npy header.
_NPY_ERRORS = (
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
    """Return the (n, 4) float32 points of a file; points that are not finite are dropped.

    Args:
        path: .bin of float32, .npy of (n, columns), .pcd or .ply.
        columns: number of columns of .bin and .npy files: x, y, z, intensity (0 if there are only
            three columns), others (ignored).
        intensity_scale: the value of full intensity in the file, e.g. 255; intensities are divided
            by it and clipped to [0, 1].

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
        raise DataError(f"{path}: not a point file; supported are {', '.join(CLOUD_SUFFIXES)}")
    points = np.zeros((len(table), 4), dtype=np.float32)
    with np.errstate(over="ignore"):  # values beyond float32 become infinite and are dropped below
        points[:, : min(table.shape[1], 4)] = table[:, :4]
    points = points[np.isfinite(points).all(axis=1)]
    check_point_range(path, points)
    points[:, 3] = np.clip(points[:, 3] / intensity_scale, 0, 1)
    return points


def _read_bin(path: Path, columns: int) -> np.ndarray:
    content = read_bytes(path, "point")
    if len(content) % (4 * columns):
        raise DataError(
            f"{path}: {len(content)} bytes are not a multiple of {4 * columns} (rows of {columns} "
            "float32); set columns"
        )
    return np.frombuffer(content, dtype="<f4").reshape(-1, columns)


def _read_npy(path: Path, columns: int) -> np.ndarray:
    try:
        # A memory map: a header that claims more than the file contains allocates no memory, and
        # pickles and archives are rejected.
        with warnings.catch_warnings():
            # Python warns about odd literals in the header, numpy about files written by Python 2.
            warnings.simplefilter("ignore")
            table = np.lib.format.open_memmap(path, mode="r")
    except FileNotFoundError:
        raise DataError(f"{path}: no such point file") from None
    except _NPY_ERRORS as error:
        raise DataError(f"{path}: not a readable .npy array: {one_line(error, 200)}") from None
    if table.ndim != 2 or table.shape[1] != columns or table.dtype.kind not in "fiu":
        raise DataError(
            f"{path}: {table.dtype} {list(table.shape)}, expected [n, {columns}]; set columns"
        )
    return np.array(table)
