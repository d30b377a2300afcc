"""Readers of PCD and PLY point clouds that do not trust the file header.

Sources: the PCD file format of the Point Cloud Library (v0.7) and Turk's PLY. The readers of common
libraries trust the header, so damaged files crash them. Here the header gives a numpy type and a
row count, and both are checked against the size of the file before anything is allocated. Which
columns are x, y, z and the intensity follows from their names (see `PointLayout`). Padding is
skipped: PCD's fields "_", and fields of any name with COUNT 0, which take no bytes.

Example: the PCD header "FIELDS x y z rgb / SIZE 4 4 4 4 / TYPE F F F U / COUNT 1 1 1 1 /
POINTS 2 / DATA binary" becomes rows of [("0", "<f4", (1,)), ("1", "<f4", (1,)), ("2", "<f4",
(1,)), ("3", "<u4", (1,))], 16 bytes each. So 32 bytes must follow the header, and fields 0, 1 and 2
are x, y and z. Fields are numbered because their names may repeat.
"""

import logging
import struct
from codecs import BOM_UTF8
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from curate.datasets.formats.point_layout import UNDECLARED, PointLayout
from curate.errors import DataError

_log = logging.getLogger(__name__)

# Number of bytes in which a header must end; real ones are a dozen lines.
_MAX_HEADER = 1 << 16
_COMMENTS = (b"#", b"comment", b"obj_info")
# LZF, the compression of PCD, expands 3 bytes to at most 264.
_LZF_RATIO = 90
_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"), **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"), **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"), **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"), **dict.fromkeys(("double", "float64"), "f8"),
}  # fmt: skip
_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_PCD_SIZES = {"F": "48", "I": "1248", "U": "1248"}
_PCD_LISTS = ("FIELDS", "SIZE", "TYPE", "COUNT")
_PCD_PADDING = "_"
_PCD_IDENTITY = [0.0, 0, 0, 1, 0, 0, 0]  # position, and rotation as a quaternion, w first


@dataclass
class PlyElement:
    """A PLY element: its row count and properties; with a list property it has no fixed size."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    has_list: bool = False


@dataclass(frozen=True)
class PcdHeader:
    """The header of a PCD file.

    Attributes:
        encoding: ascii, binary or binary_compressed.
        points: number of points.
        names: name of each field; "" for padding.
        row: numpy type of one point; its fields are numbered, because names may repeat.
    """

    encoding: str
    points: int
    names: list[str]
    row: np.dtype


def read_pcd(path: Path, content: bytes, layout: PointLayout = UNDECLARED) -> np.ndarray:
    """Return (n, 3) x, y, z, or (n, 4) with intensity if there is one, of a PCD file.

    An organised cloud is returned row after row. VIEWPOINT, the pose of the sensor, is not applied:
    the points are returned as they are stored, and a pose other than the identity is logged.

    Raises:
        DataError: if the file is malformed, truncated, or has no x, y, z, or several fields may be
            the intensity.
    """
    lines, start = split_header(path, content, "DATA")
    header = parse_pcd_header(path, lines)
    columns = layout.indices(path, header.names)
    if header.encoding == "ascii":
        counts = [header.row[name].shape[0] for name in header.row.names or ()]
        offsets = np.cumsum([0, *counts])
        table = _parse_numbers(path, content[start:], header.points, sum(counts))
        return table[:, [offsets[column] for column in columns]]
    if header.encoding == "binary_compressed":
        fields = decompress_fields(path, content[start:], header.points, header.row)
        return np.column_stack([fields[column][:, 0] for column in columns])
    if header.encoding != "binary":
        raise DataError(
            f"{path}: DATA is {header.encoding[:20]!r}, expected ascii, binary or binary_compressed"
        )
    table = _rows(path, content, header.row, header.points, start)
    return np.column_stack([table[f"{column}"][:, 0] for column in columns])


def read_ply(path: Path, content: bytes, layout: PointLayout = UNDECLARED) -> np.ndarray:
    """Return (n, 3) x, y, z, or (n, 4) with intensity if there is one, of a PLY file's vertices.

    Raises:
        DataError: if the file is malformed, truncated, or has no vertices with x, y, z, or several
            properties may be the intensity.
    """
    lines, start = split_header(path, content, "end_header")
    try:
        order, vertex, before, types = ply_layout(lines)
    except (KeyError, IndexError, ValueError):
        raise DataError(
            f"{path}: malformed PLY header, or no vertices of a fixed number of properties"
        ) from None
    names = [name for name, _ in vertex.properties]
    columns = layout.indices(path, names)
    if not order:
        skip = sum(element.count * len(element.properties) for element in before)
        table = _parse_numbers(path, content[start:], vertex.count, len(names), skip)
        return table[:, columns]
    start += sum(
        element.count * row_type.itemsize for element, row_type in zip(before, types, strict=False)
    )
    rows = _rows(path, content, types[-1], vertex.count, start)
    return np.column_stack([rows[names[column]] for column in columns])


def split_header(path: Path, content: bytes, last: str) -> tuple[list[str], int]:
    """Return the header lines up to the one that begins with `last`, and the offset of the data.

    Only comments may contain other characters than ASCII.
    """
    lines: list[str] = []
    start = len(BOM_UTF8) if content.startswith(BOM_UTF8) else 0
    while (end := content.find(b"\n", start, _MAX_HEADER)) >= 0:
        line = content[start:end].strip()
        start = end + 1
        if not line.isascii() and not line.startswith(_COMMENTS):
            break
        lines.append(line.decode("ascii", "replace"))
        if lines[-1].casefold().split()[:1] == [last.casefold()]:
            return lines, start
    raise DataError(f"{path}: not a {path.suffix} file: there is no header that ends with {last}")


def parse_pcd_header(path: Path, lines: Sequence[str]) -> PcdHeader:
    """Return the content of a PCD header.

    Raises:
        DataError: if an entry is missing or malformed, or entries contradict each other.
    """
    entries = {words[0].upper(): words[1:] for words in map(str.split, lines) if words}
    try:
        names = entries["FIELDS"] if "FIELDS" in entries else entries["COLUMNS"]  # COLUMNS in v.5
        counts = [_natural(count) for count in entries.get("COUNT", ["1"] * len(names))]
        parts = zip(names, entries["TYPE"], entries["SIZE"], counts, strict=True)
        row = np.dtype(
            [
                (f"{i}", f"<{_pcd_type(kind.upper(), size)}", (count,))
                for i, (_, kind, size, count) in enumerate(parts)
            ]
        )
        points = _pcd_points(path, entries)
        encoding = entries["DATA"][0].lower()
        pose = [float(number) for number in entries.get("VIEWPOINT", _PCD_IDENTITY)]
    except (KeyError, IndexError, ValueError):
        lengths = ", ".join(f"{key} {len(entries[key])}" for key in _PCD_LISTS if key in entries)
        raise DataError(
            f"{path}: malformed PCD header; FIELDS, SIZE, TYPE and COUNT need one value for each "
            f"field (number of values: {lengths}), and POINTS and DATA are needed"
        ) from None
    if pose != _PCD_IDENTITY:
        _warn_of_pose(path, " ".join(entries["VIEWPOINT"])[:80])
    readable = [
        "" if name == _PCD_PADDING or not count else name
        for name, count in zip(names, counts, strict=True)
    ]
    return PcdHeader(encoding, points, readable, row)


_folders_with_poses: set[Path] = set()


def _warn_of_pose(path: Path, pose: str) -> None:
    """Log a pose that is not applied, once per folder."""
    if path.parent not in _folders_with_poses:
        _folders_with_poses.add(path.parent)
        _log.warning(
            "%s: VIEWPOINT is %s and is not applied; the points must be in the frame of reference "
            "of the LiDAR, as the calibration assumes",
            path,
            pose,
        )


def _pcd_points(path: Path, entries: Mapping[str, list[str]]) -> int:
    """Return the number of points: POINTS, or WIDTH times HEIGHT, which must be equal."""
    size = [_natural(entries[key][0]) for key in ("WIDTH", "HEIGHT") if key in entries]
    if "POINTS" not in entries and len(size) == 2:
        return size[0] * size[1]
    points = _natural(entries["POINTS"][0])
    if len(size) == 2 and size[0] * size[1] != points:
        raise DataError(
            f"{path}: POINTS is {points}, but WIDTH {size[0]} times HEIGHT {size[1]} is "
            f"{size[0] * size[1]}; write the file again"
        )
    return points


def ply_layout(lines: Sequence[str]) -> tuple[str, PlyElement, list[PlyElement], list[np.dtype]]:
    """Return byte order, vertex element, the elements before it, and the row types of them all.

    Raises:
        KeyError: if a format or a type is unknown.
        IndexError: if a property comes before the first element.
        ValueError: if the header is malformed, or has no vertices of a fixed size.
    """
    order, elements = _elements(lines)
    index = [element.name for element in elements].index("vertex")
    needed = elements[: index + 1]
    if any(element.has_list for element in needed):
        raise ValueError("list")
    # numpy raises ValueError if a property name repeats.
    types = [
        np.dtype([(name, f"{order or '<'}{kind}") for name, kind in element.properties])
        for element in needed
    ]
    return order, elements[index], elements[:index], types


def _elements(lines: Sequence[str]) -> tuple[str, list[PlyElement]]:
    """Return the byte order of a PLY header, "" for text, and its elements."""
    if lines[0] != "ply":
        raise ValueError(lines[0])
    order: str | None = None
    elements: list[PlyElement] = []
    for words in map(str.split, lines[1:]):
        match words:
            case ["format", encoding, *_]:
                order = _PLY_ORDERS[encoding]
            case ["element", name, count]:
                elements.append(PlyElement(name, _natural(count)))
            case ["property", "list", *_]:
                elements[-1].has_list = True
            case ["property", kind, name]:
                elements[-1].properties.append((name, _PLY_TYPES[kind]))
    if order is None:
        raise ValueError("no format")
    return order, elements


def _pcd_type(kind: str, size: str) -> str:
    if size not in _PCD_SIZES[kind]:
        raise ValueError(size)
    return f"{kind.lower()}{size}"


def _natural(word: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) < 16):
        raise ValueError(word)
    return int(word)


def _parse_numbers(path: Path, text: bytes, rows: int, width: int, skip: int = 0) -> np.ndarray:
    """Return (rows, width) numbers of a text after the first `skip`; more may follow."""
    end = skip + rows * width
    words = text.split(None, end) if end <= len(text) else []
    if len(words) < end:
        raise DataError(
            f"{path}: the header claims {rows} points of {width} numbers, but fewer follow; the "
            "file is truncated or damaged"
        )
    try:
        values = [float(word) for word in words[skip:end]]
    except ValueError:
        raise DataError(f"{path}: contains words that are not numbers") from None
    return np.array(values, dtype=np.float64).reshape(rows, width)


def _rows(path: Path, content: bytes, row: np.dtype, count: int, start: int) -> np.ndarray:
    """Return (count,) rows of a structured type from binary content."""
    if start + count * row.itemsize > len(content):
        raise DataError(
            f"{path}: the header claims {count} points of {row.itemsize} bytes, but only "
            f"{max(len(content) - start, 0)} bytes follow; the file is truncated or damaged"
        )
    return np.frombuffer(content, row, count, start) if count else np.zeros(0, row)


def decompress_fields(path: Path, content: bytes, points: int, row: np.dtype) -> list[np.ndarray]:
    """Return the (points, count) values of each field of a compressed PCD.

    The content is the compressed size, the decompressed size, and the compressed bytes. These
    contain one field after the other: all x, then all y, and so on.
    """
    packed, size = struct.unpack("<II", content[:8]) if len(content) >= 8 else (0, 0)
    fits = size == points * row.itemsize and 8 + packed <= len(content)
    if not fits or size > packed * _LZF_RATIO:
        raise DataError(f"{path}: the compressed points do not fit the header; the file is damaged")
    unpacked = np.zeros(size, dtype=np.uint8)
    source = np.frombuffer(content, np.uint8, packed, 8) if packed else unpacked
    from curate.datasets.formats.lzf import unpack

    if unpack(source, unpacked) != size:
        raise DataError(f"{path}: the compressed points are damaged; fetch the file again")
    fields, start = [], 0
    for name in row.names or ():
        field_type = row[name]
        end = start + points * field_type.itemsize
        fields.append(unpacked[start:end].view(field_type.base).reshape(points, *field_type.shape))
        start = end
    return fields
