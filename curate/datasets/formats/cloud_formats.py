"""Readers of PCD and PLY point clouds that do not trust the file header.

Sources: the PCD file format of the Point Cloud Library (v0.7) and Turk's PLY. The readers of common
libraries trust the header, so damaged files crash them. Here the header gives a numpy type and a
row count, and both are checked against the size of the file before anything is allocated.

Example: the PCD header "FIELDS x y z rgb / SIZE 4 4 4 4 / TYPE F F F U / COUNT 1 1 1 1 /
POINTS 2 / DATA binary" becomes rows of [("0", "<f4", (1,)), ("1", "<f4", (1,)), ("2", "<f4",
(1,)), ("3", "<u4", (1,))], 16 bytes each. So 32 bytes must follow the header, and fields 0, 1 and 2
are x, y and z. Fields are numbered because their names may repeat.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from curate.errors import DataError

# Number of bytes in which a header must end; real ones are a dozen lines.
_MAX_HEADER = 1 << 16
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
_COLUMNS = ("x", "y", "z", "intensity")


@dataclass
class _Element:
    """A PLY element: its row count and properties; with a list property it has no fixed size."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    has_list: bool = False


def read_pcd(path: Path, content: bytes) -> np.ndarray:
    """Return (n, 3) x, y, z, or (n, 4) with intensity if there is one, of a PCD file.

    Raises:
        DataError: if the file is malformed, truncated, or has no x, y, z.
    """
    lines, start = _header(path, content, "DATA ")
    try:
        encoding, points, counts, row, columns = _pcd_layout(lines)
    except (KeyError, IndexError, ValueError):
        raise DataError(f"{path}: malformed PCD header, or no fields x, y, z") from None
    if encoding == "ascii":
        offsets = np.cumsum([0, *counts])
        table = _parse_numbers(path, content[start:], points, sum(counts))
        return table[:, [offsets[column] for column in columns]]
    if encoding == "binary_compressed":
        fields = _decompress_fields(path, content[start:], points, row)
        return np.column_stack([fields[column] for column in columns])
    if encoding != "binary":
        raise DataError(
            f"{path}: DATA is {encoding[:20]!r}, expected ascii, binary or binary_compressed"
        )
    table = _rows(path, content, row, points, start)
    return np.column_stack([table[f"{column}"][:, 0] for column in columns])


def read_ply(path: Path, content: bytes) -> np.ndarray:
    """Return (n, 3) x, y, z, or (n, 4) with intensity if there is one, of a PLY file's vertices.

    Raises:
        DataError: if the file is malformed, truncated, or has no vertices with x, y, z.
    """
    lines, start = _header(path, content, "end_header")
    try:
        order, vertex, before, types = _ply_layout(lines)
    except (KeyError, IndexError, ValueError):
        raise DataError(f"{path}: malformed PLY header, or no vertices with x, y, z") from None
    columns = [name for name in _COLUMNS if name in dict(vertex.properties)]
    if not order:
        skip = sum(element.count * len(element.properties) for element in before)
        table = _parse_numbers(path, content[start:], vertex.count, len(vertex.properties), skip)
        return table[:, [list(dict(vertex.properties)).index(name) for name in columns]]
    start += sum(
        element.count * row_type.itemsize for element, row_type in zip(before, types, strict=False)
    )
    rows = _rows(path, content, types[-1], vertex.count, start)
    return np.column_stack([rows[name] for name in columns])


def _header(path: Path, content: bytes, last: str) -> tuple[list[str], int]:
    """Return the header lines up to the one that starts with `last`, and the offset of the data."""
    lines: list[str] = []
    start = 0
    while (end := content.find(b"\n", start, _MAX_HEADER)) >= 0:
        line = content[start:end]
        start = end + 1
        if not line.isascii():
            break
        lines.append(line.decode("ascii").strip())
        if lines[-1].startswith(last):
            return lines, start
    raise DataError(
        f"{path}: not a {path.suffix} file: there is no header that ends with {last.strip()}"
    )


def _pcd_layout(lines: Sequence[str]) -> tuple[str, int, list[int], np.dtype, list[int]]:
    """Return encoding, number of points, numbers per field, row type, and the fields to read.

    Raises:
        KeyError: if an entry or a type is missing or unknown.
        IndexError: if an entry has no value.
        ValueError: if a value is malformed, or x, y or z is missing.
    """
    entries = {words[0]: words[1:] for words in map(str.split, lines) if words}
    names = entries["FIELDS"]
    counts = [_natural(count) for count in entries.get("COUNT", ["1"] * len(names))]
    parts = zip(entries["TYPE"], entries["SIZE"], counts, strict=True)
    row = np.dtype(
        [(f"{i}", f"<{_pcd_type(kind, size)}", (n,)) for i, (kind, size, n) in enumerate(parts)]
    )
    if len(counts) != len(names) or min(counts) < 1 or not {"x", "y", "z"} <= set(names):
        raise ValueError("fields")
    columns = [names.index(name) for name in _COLUMNS if name in names]
    return entries["DATA"][0], _natural(entries["POINTS"][0]), counts, row, columns


def _ply_layout(lines: Sequence[str]) -> tuple[str, _Element, list[_Element], list[np.dtype]]:
    """Return byte order, vertex element, the elements before it, and the row types of them all.

    Raises:
        KeyError: if a format or a type is unknown.
        IndexError: if a property comes before the first element.
        ValueError: if the header is malformed, or has no vertices of a fixed size with x, y, z.
    """
    order, elements = _elements(lines)
    index = [element.name for element in elements].index("vertex")
    needed = elements[: index + 1]
    if any(element.has_list for element in needed):
        raise ValueError("list")
    if not {"x", "y", "z"} <= set(dict(elements[index].properties)):
        raise ValueError("vertex")
    # numpy raises ValueError if a property name repeats.
    types = [
        np.dtype([(name, f"{order or '<'}{kind}") for name, kind in element.properties])
        for element in needed
    ]
    return order, elements[index], elements[:index], types


def _elements(lines: Sequence[str]) -> tuple[str, list[_Element]]:
    """Return the byte order of a PLY header, "" for text, and its elements."""
    if lines[0] != "ply":
        raise ValueError(lines[0])
    order: str | None = None
    elements: list[_Element] = []
    for words in map(str.split, lines[1:]):
        match words:
            case ["format", encoding, *_]:
                order = _PLY_ORDERS[encoding]
            case ["element", name, count]:
                elements.append(_Element(name, _natural(count)))
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


def _decompress_fields(path: Path, content: bytes, points: int, row: np.dtype) -> list[np.ndarray]:
    """Return the first column of each field of a compressed PCD.

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
        values = unpacked[start:end].view(field_type.base)
        fields.append(values.reshape(points, *field_type.shape)[:, 0])
        start = end
    return fields
