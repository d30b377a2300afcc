"""Reader of point clouds in several file formats: x, y, z in metres and intensity in [0, 1].

Files without a header are read with a declared number of columns, and rejected if they look like
another one (see `readings`). Intensities are checked against the declared full intensity before
they are clipped.
"""

import os
from pathlib import Path

import numpy as np

from curate.datasets.formats.binary import open_unbuffered, read_bytes
from curate.datasets.formats.cloud_formats import read_pcd, read_ply
from curate.datasets.formats.point_layout import UNDECLARED, PointLayout
from curate.datasets.formats.readings import better_readings, fitting
from curate.errors import DataError
from curate.files.npy import map_npy
from curate.shapes import Float, Float32

CLOUD_SUFFIXES = (".bin", ".npy", ".pcd", ".ply")
# Beyond the range of any LiDAR. Farther points would make grids over the points too large.
MAX_RANGE_METRES = 2000.0
_VALUE_BYTES = 4
# Values up to 1 % above full intensity are rounding, and one point in 1000 may be saturated, as
# retroreflectors are; these are clipped.
_ROUNDING = 0.01
_SATURATED_SHARE = 0.001
# If at most this share of the points is above full intensity, and one of them is this many times as
# bright, then a larger scale would turn all others dark. Waymo's raw intensities are like this.
_LONG_TAIL_SHARE, _LONG_TAIL = 0.05, 10
_USUAL_SCALES = (255, 4095, 65535)
# A file without an apparent problem is not rejected because a few rows look better otherwise.
_LEAST_ROWS = 4
_MISSING = "contains NaN or infinite numbers"


def read_cloud(
    path: Path, layout: PointLayout = UNDECLARED, *, drop_missing: bool = True
) -> Float32[np.ndarray, "n 4"]:
    """Return the (n, 4) float32 points of a file: x, y, z in metres, intensity in [0, 1].

    The intensity is 0 if the file has none.

    Args:
        path: .bin of float32 rows, .npy of (n, columns) or with named fields, .pcd or .ply.
        layout: the declared layout.
        drop_missing: whether points with NaN or infinite numbers are dropped; organised clouds
            mark missing returns in this way. Otherwise, a .bin file with such points is rejected.

    Raises:
        DataError: if the file is missing, damaged or of another format, if it may be read with
            another number of columns, or if coordinates or intensities are out of range.
    """
    suffix = path.suffix.lower()
    if suffix == ".bin":
        return _read_bin(path, layout, drop_missing=drop_missing)
    if suffix == ".npy":
        table = _read_npy(path, layout)
    elif suffix in CLOUD_SUFFIXES:
        read = read_pcd if suffix == ".pcd" else read_ply
        table = read(path, read_bytes(path, "point"), layout)
    else:
        raise DataError(f"{path}: not a point file; supported are {', '.join(CLOUD_SUFFIXES)}")
    points = np.zeros((len(table), 4), dtype=np.float32)
    with np.errstate(over="ignore"):  # values beyond float32 become infinite and are dropped below
        points[:, : table.shape[1]] = table
    points = points[np.isfinite(points).all(axis=1)]
    problem = _problem(points, layout)
    if problem:
        raise DataError(f"{path}: {problem}")
    return _scaled(points, layout)


def _read_bin(path: Path, layout: PointLayout, *, drop_missing: bool) -> Float32[np.ndarray, "n 4"]:
    """Return the points of a file without a header; see `read_cloud`."""
    values = _read_values(path, layout)
    names = layout.names
    table = values.reshape(-1, len(names))
    chosen = layout.indices(path, names)
    if chosen == [0, 1, 2, 3] and len(names) == 4:
        points = table
    else:
        points = np.zeros((len(table), 4), dtype=np.float32)
        points[:, : len(chosen)] = table[:, chosen]
    problem = _problem(points, layout)
    missing = np.zeros(0, dtype=int)
    if problem is _MISSING:
        finite = np.isfinite(points).all(axis=1)
        missing = np.flatnonzero(~finite)
        points = points[finite]
        problem = _problem(points, layout)
    # A declared layout needs a second look only if something is wrong with the points.
    if problem or len(missing) or not layout.is_declared:
        others = better_readings(values, len(names), least_rows=1 if problem else _LEAST_ROWS)
        if others:
            raise DataError(_two_readings(path, values, len(names), others, problem))
    if len(missing) and not drop_missing:
        raise DataError(
            f"{path}: {len(missing)} of {len(table)} points are NaN or infinite, "
            f"the first is point {missing[0]}; remove them from the file"
        )
    if problem:
        raise DataError(f"{path}: {problem}")
    return _scaled(points, layout)


def _read_values(path: Path, layout: PointLayout) -> Float32[np.ndarray, " m"]:
    """Return all numbers of a .bin file; their number is divisible by that of the columns."""
    columns = len(layout.names)
    with open_unbuffered(path, "point") as file:
        size = os.fstat(file.fileno()).st_size
        values = np.empty(size // _VALUE_BYTES, dtype="<f4")
        count = file.readinto(values.view(np.uint8).data)
    row_bytes = _VALUE_BYTES * columns
    if size % row_bytes == 0 and count == size:
        return values
    problem = (
        f"{path}: {size} bytes are not a multiple of {row_bytes} (rows of {columns} float32: "
        f"{', '.join(name or '?' for name in layout.names)})"
    )
    others = better_readings(values, columns) if size % _VALUE_BYTES == 0 else ()
    if others:
        raise DataError(f"{problem}; {_fit(others)}: {_set_columns(others)}")
    possible = fitting(len(values)) if size % _VALUE_BYTES == 0 else ()
    hint = f", or set dataset.columns ({_fit(possible)})" if possible else ""
    raise DataError(f"{problem}; the file is truncated, fetch it again{hint}")


def _two_readings(
    path: Path, values: np.ndarray, columns: int, others: tuple[int, ...], problem: str | None
) -> str:
    """Return the message for a file that looks like another number of columns."""
    counts = " or ".join(f"{len(values) // other} of {other}" for other in others)
    reason = f" ({problem.partition(';')[0]})" if problem else ""
    return (
        f"{path}: {values.nbytes} bytes can be read as {len(values) // columns} points of "
        f"{columns} float32{reason} or, more likely, {counts}; {_set_columns((*others, columns))}"
    )


def _fit(columns: object) -> str:
    return f"rows of {_either(columns)} float32 fit"


def _set_columns(columns: tuple[int, ...]) -> str:
    return f"set dataset.columns = {_either(columns)}, or name them in dataset.column_names"


def _either(numbers: object) -> str:
    return " or ".join(map(str, numbers))  # type: ignore[call-overload]


def _problem(points: Float[np.ndarray, "n 4"], layout: PointLayout) -> str | None:
    """Return what is wrong with the points and how to fix it, or None; `_MISSING` for NaN."""
    # Fast path: the extremes over all columns reveal NaN and infinite numbers as well.
    low, high = float(points.min(initial=0)), float(points.max(initial=0))
    if not (np.isfinite(low) and np.isfinite(high)):
        return _MISSING
    if low < -MAX_RANGE_METRES or high > MAX_RANGE_METRES:
        far = np.abs(points[:, :3]).max(axis=1)
        k = int(far.argmax())
        if np.median(far) > MAX_RANGE_METRES:
            return (
                f"most points are {np.median(far):.4g} m away; points must be in metres from the "
                "LiDAR, so subtract its position if these are coordinates of a map, and divide by "
                "1000 if they are millimetres"
            )
        if far[k] > MAX_RANGE_METRES:
            return (
                f"point {k} is {far[k]:.4g} m away; points must be in metres from the LiDAR, "
                f"remove those beyond {MAX_RANGE_METRES:g} m"
            )
    return _intensity_problem(np.ascontiguousarray(points[:, 3]), layout.full_intensity)


def _intensity_problem(intensities: Float[np.ndarray, " n"], full: float) -> str | None:
    """Return what is wrong with the intensities and how to fix it, or None."""
    margin = _ROUNDING * full
    low, high = float(intensities.min(initial=0)), float(intensities.max(initial=0))
    if low >= -margin and high <= full + margin:
        return None
    tolerated = int(_SATURATED_SHARE * len(intensities))
    negative = int((intensities < -margin).sum())
    if negative > tolerated:
        return (
            f"{negative} of {len(intensities)} intensities are negative, down to {low:.4g}; if "
            "this column is not the intensity, name the columns in dataset.column_names"
        )
    above = int((intensities > full + margin).sum())
    if tolerated < above <= _LONG_TAIL_SHARE * len(intensities) and high > _LONG_TAIL * full:
        return (
            f"{above} of {len(intensities)} intensities are above the full intensity {full:g}, up "
            f"to {high:.4g}, but {1 - above / len(intensities):.1%} are not: clip them to {full:g} "
            "or take their tanh in the files or, if large values are usual, set "
            "dataset.intensity_scale to the value of full intensity"
        )
    if above > tolerated:
        usual = [scale for scale in _USUAL_SCALES if high <= scale]
        value = f"dataset.intensity_scale = {usual[0]}" if usual else "dataset.intensity_scale"
        return (
            f"{above} of {len(intensities)} intensities are above the full intensity {full:g}, up "
            f"to {high:.4g}; set {value}, the value of full intensity in the files"
        )
    return None


def _scaled(points: Float32[np.ndarray, "n 4"], layout: PointLayout) -> Float32[np.ndarray, "n 4"]:
    """Divide the intensities by the full intensity and clip them to [0, 1], in place."""
    intensities = np.ascontiguousarray(points[:, 3])
    if layout.full_intensity != 1:
        intensities /= np.float32(layout.full_intensity)
    if intensities.min(initial=0) < 0 or intensities.max(initial=0) > 1:
        np.clip(intensities, 0, 1, out=intensities)
    elif layout.full_intensity == 1:
        return points
    points[:, 3] = intensities
    return points


def _read_npy(path: Path, layout: PointLayout) -> np.ndarray:
    """Return x, y, z and, if there is one, the intensity of an array."""
    table = map_npy(path, "point")
    if table.dtype.names:
        return _named_fields(path, table, layout)
    columns = len(layout.names)
    if table.ndim != 2 or table.shape[1] != columns or table.dtype.kind not in "fiu":
        fits = table.ndim == 2 and table.shape[1] >= 3 and table.dtype.kind in "fiu"
        hint = f" = {table.shape[1]}, or name them in dataset.column_names" if fits else ""
        raise DataError(
            f"{path}: {table.dtype} {list(table.shape)}, expected [n, {columns}]; set "
            f"dataset.columns{hint}"
        )
    return np.array(table[:, layout.indices(path, layout.names)])


def _named_fields(path: Path, table: np.ndarray, layout: PointLayout) -> np.ndarray:
    """Return x, y, z and the intensity of a structured array; an organised cloud is flattened."""
    names = [
        name if table.dtype[name].kind in "fiu" and not table.dtype[name].shape else ""
        for name in table.dtype.names or ()
    ]
    chosen = layout.indices(path, names)
    return np.column_stack([np.asarray(table[names[k]]).ravel() for k in chosen])
