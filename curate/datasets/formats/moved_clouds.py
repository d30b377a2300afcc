"""Copies of point files with other coordinates: format, columns and their order stay.

Only x, y and z are written anew. All other columns, such as intensity, ring and time, keep their
bytes or their text. A compressed PCD becomes an uncompressed one.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from curate.datasets.formats.binary import read_bytes
from curate.datasets.formats.cloud_formats import (
    decompress_fields,
    parse_pcd_header,
    ply_layout,
    split_header,
)
from curate.datasets.formats.point_layout import PointLayout
from curate.errors import ConfigError, DataError
from curate.files.atomic import atomic_path, replace_file
from curate.files.npy import map_npy
from curate.shapes import Bool, Float

Move = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]
"""Returns the new coordinates of points, in the same dtype."""
Keep = Callable[[Float[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]]
"""Returns which points are kept, from their original coordinates."""

_COMPRESSED = b"binary_compressed"


def move_cloud(
    source: Path, target: Path, layout: PointLayout, move: Move, keep: Keep | None = None
) -> None:
    """Write the points of a file with other coordinates, atomically.

    Args:
        source: a file that `clouds.read_cloud` reads with this layout.
        target: the file to write; its suffix is that of the source.
        layout: the layout of the source.
        move: returns the new x, y, z of the points.
        keep: returns which points are written; None for all.

    Raises:
        ConfigError: if only some points of a file with a header are to be written.
        DataError: if the file is missing or damaged, or coordinates are integers in a file with
            named fields, which cannot hold other ones.
    """
    suffix = source.suffix.lower()
    if suffix == ".bin":
        names = layout.names
        values = np.frombuffer(bytearray(read_bytes(source, "point")), "<f4")
        table = values.reshape(-1, len(names))
        table = _moved_rows(table, layout.indices(source, names)[:3], move, keep)
        replace_file(target, table.tobytes())
    elif suffix == ".npy" and (keep is None or map_npy(source, "point").dtype.names is None):
        _move_npy(source, target, layout, move, keep)
    elif keep is not None:
        raise ConfigError(
            f"{source}: only .bin files and .npy files of rows can be written in part; leave out "
            "--camera-view, the calibration of the copies fits a crop by the detector"
        )
    elif suffix == ".pcd":
        replace_file(target, _moved_pcd(source, layout, move))
    else:
        replace_file(target, _moved_ply(source, layout, move))


def _moved(points: np.ndarray, move: Move) -> np.ndarray:
    with np.errstate(invalid="ignore"):  # organised clouds mark missing returns by NaN
        return move(points)


def _moved_rows(
    table: np.ndarray, columns: Sequence[int], move: Move, keep: Keep | None
) -> np.ndarray:
    """Return (m, c) the kept ones of (n, c) rows, with other coordinates."""
    points = table[:, columns]
    if keep is not None:
        kept = keep(points)
        table, points = table[kept], points[kept]
    table[:, columns] = _moved(points, move)
    return table


def _move_npy(
    source: Path, target: Path, layout: PointLayout, move: Move, keep: Keep | None
) -> None:
    table = np.array(map_npy(source, "point"))
    names = table.dtype.names
    if names is None:
        if table.dtype.kind != "f":
            table = table.astype(np.float64)
        table = _moved_rows(table, layout.indices(source, layout.names)[:3], move, keep)
    else:
        axes = [names[k] for k in layout.indices(source, names)[:3]]
        _check_floats(source, [table.dtype[name] for name in axes])
        flat = np.column_stack([table[name].ravel() for name in axes])
        for name, column in zip(axes, _moved(flat, move).T, strict=True):
            table[name] = column.reshape(table.shape)
    with atomic_path(target) as partial, partial.open("wb") as file:
        np.lib.format.write_array(file, table, allow_pickle=False)


def _moved_pcd(path: Path, layout: PointLayout, move: Move) -> bytes:
    """Return the content of a PCD file with other coordinates."""
    content = read_bytes(path, "point")
    lines, start = split_header(path, content, "DATA")
    header = parse_pcd_header(path, lines)
    columns = layout.indices(path, header.names)[:3]
    names = header.row.names or ()
    types = [header.row[names[column]].base for column in columns]
    _check_floats(path, types)
    if header.encoding == "ascii":
        counts = [header.row[name].shape[0] for name in names]
        offsets = np.cumsum([0, *counts])[columns].tolist()
        body = _moved_words(content[start:], header.points, sum(counts), 0, offsets, types, move)
        return content[:start] + body
    head = content[:start]
    if header.encoding == "binary_compressed":
        rows = np.zeros(header.points, header.row)
        fields = decompress_fields(path, content[start:], header.points, header.row)
        for name, values in zip(names, fields, strict=True):
            rows[name] = values
        place = head.lower().rindex(_COMPRESSED)
        head = head[:place] + b"binary" + head[place + len(_COMPRESSED) :]
    else:
        rows = np.frombuffer(content, header.row, header.points, start).copy()
    axes = [f"{column}" for column in columns]
    flat = np.column_stack([rows[axis][:, 0] for axis in axes])
    for axis, column in zip(axes, _moved(flat, move).T, strict=True):
        rows[axis][:, 0] = column
    return head + rows.tobytes()


def _moved_ply(path: Path, layout: PointLayout, move: Move) -> bytes:
    """Return the content of a PLY file with other coordinates; its other elements stay."""
    content = read_bytes(path, "point")
    lines, start = split_header(path, content, "end_header")
    order, vertex, before, types = ply_layout(lines)
    names = [name for name, _ in vertex.properties]
    columns = layout.indices(path, names)[:3]
    row = types[-1]
    axes = [names[column] for column in columns]
    _check_floats(path, [row[axis] for axis in axes])
    if not order:
        skip = sum(element.count * len(element.properties) for element in before)
        body = _moved_words(
            content[start:], vertex.count, len(names), skip, columns, [row[a] for a in axes], move
        )
        return content[:start] + body
    start += sum(
        element.count * kind.itemsize for element, kind in zip(before, types, strict=False)
    )
    rows = np.frombuffer(content, row, vertex.count, start).copy()
    native = row[axes[0]].newbyteorder("=")
    flat = np.column_stack([rows[axis] for axis in axes]).astype(native)
    for axis, column in zip(axes, _moved(flat, move).T, strict=True):
        rows[axis] = column
    return content[:start] + rows.tobytes() + content[start + rows.nbytes :]


def _moved_words(
    text: bytes,
    rows: int,
    width: int,
    skip: int,
    columns: Sequence[int],
    types: Sequence[np.dtype],
    move: Move,
) -> bytes:
    """Return a text of `rows` lines of `width` numbers with other coordinates.

    Args:
        text: the text, which may go on after the rows.
        rows: number of points.
        width: numbers of each point.
        skip: numbers before the first point.
        columns: the columns of x, y and z.
        types: their types.
        move: see `move_cloud`.
    """
    end = skip + rows * width
    words = text.split(None, end)
    table = np.array(words[skip:end], dtype=object).reshape(rows, width)
    points = table[:, columns].astype(np.result_type(*types))
    for column, values in zip(columns, _moved(points, move).T, strict=True):
        table[:, column] = [str(value).encode() for value in values]
    head = [b" ".join(words[:skip])] if skip else []
    return b"\n".join([*head, *map(b" ".join, table.tolist()), *words[end:]]) + b"\n"


def _check_floats(path: Path, types: Sequence[np.dtype]) -> None:
    if any(each.kind != "f" for each in types):
        raise DataError(
            f"{path}: x, y and z are integers, which cannot hold turned coordinates; write the "
            "file again with float coordinates"
        )
