"""PCD and PLY point clouds, read without trusting what their headers claim.

Sources: the PCD file format of the Point Cloud Library (v0.7) and Turk's PLY. The readers of common
libraries take a header at its word, and damaged files crash them; here a header makes a numpy type
and a count, and both must fit the bytes that are there.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from curate.errors import DataError

# Headers are a dozen lines; a file that has not ended its own by then is none.
_LONGEST_HEADER = 1 << 16
# PCD's compression, LZF, makes at most 264 bytes of 3.
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
    """A PLY element: how many rows of which properties; a list has no fixed size."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    has_list: bool = False


def read_pcd(path: Path, content: bytes) -> np.ndarray:
    """Return the (n, 3 or 4) x, y, z and, where there is one, intensity of a PCD file.

    Raises:
        DataError: if the file is malformed, truncated, or has no x, y, z.
    """
    lines, start = _header(path, content, "DATA ")
    try:
        form, points, counts, row, columns = _pcd_layout(lines)
    except (KeyError, IndexError, ValueError):
        raise DataError(f"{path}: a malformed PCD header, or one without x, y, z") from None
    if form == "ascii":
        firsts = np.cumsum([0, *counts])
        table = _numbers(path, content[start:], points, sum(counts))
        return table[:, [firsts[column] for column in columns]]
    if form == "binary_compressed":
        fields = _decompressed(path, content[start:], points, row)
        return np.column_stack([fields[column] for column in columns])
    if form != "binary":
        raise DataError(f"{path}: DATA {form[:20]!r}; known are ascii, binary, binary_compressed")
    table = _rows(path, content, row, points, start)
    return np.column_stack([table[f"{column}"][:, 0] for column in columns])


def read_ply(path: Path, content: bytes) -> np.ndarray:
    """Return the (n, 3 or 4) x, y, z and, where there is one, intensity of a PLY file's vertices.

    Raises:
        DataError: if the file is malformed, truncated, or has no vertices with x, y, z.
    """
    lines, start = _header(path, content, "end_header")
    try:
        order, vertex, before, types = _ply_layout(lines)
    except (KeyError, IndexError, ValueError):
        raise DataError(
            f"{path}: a malformed PLY header, or one without x, y, z of vertices"
        ) from None
    columns = [name for name in _COLUMNS if name in dict(vertex.properties)]
    if not order:
        first = sum(element.count * len(element.properties) for element in before)
        table = _numbers(path, content[start:], vertex.count, len(vertex.properties), first)
        return table[:, [list(dict(vertex.properties)).index(name) for name in columns]]
    start += sum(
        element.count * kind.itemsize for element, kind in zip(before, types, strict=False)
    )
    rows = _rows(path, content, types[-1], vertex.count, start)
    return np.column_stack([rows[name] for name in columns])


def _header(path: Path, content: bytes, last: str) -> tuple[list[str], int]:
    """Return the lines up to the one that starts with `last`, and where the data begin."""
    lines: list[str] = []
    start = 0
    while (end := content.find(b"\n", start, _LONGEST_HEADER)) >= 0:
        line = content[start:end]
        start = end + 1
        if not line.isascii():
            break
        lines.append(line.decode("ascii").strip())
        if lines[-1].startswith(last):
            return lines, start
    raise DataError(f"{path}: no header of a {path.suffix} file, which ends in {last.strip()}")


def _pcd_layout(lines: Sequence[str]) -> tuple[str, int, list[int], np.dtype, list[int]]:
    """The form, how many points, numbers per field, the type of a row, and the fields to read."""
    told = {words[0]: words[1:] for words in map(str.split, lines) if words}
    names = told["FIELDS"]
    counts = [_natural(count) for count in told.get("COUNT", ["1"] * len(names))]
    parts = zip(told["TYPE"], told["SIZE"], counts, strict=True)
    row = np.dtype(
        [(f"{i}", f"<{_pcd_type(kind, size)}", (n,)) for i, (kind, size, n) in enumerate(parts)]
    )
    if len(counts) != len(names) or min(counts) < 1 or not {"x", "y", "z"} <= set(names):
        raise ValueError("fields")
    columns = [names.index(name) for name in _COLUMNS if name in names]
    return told["DATA"][0], _natural(told["POINTS"][0]), counts, row, columns


def _ply_layout(lines: Sequence[str]) -> tuple[str, _Element, list[_Element], list[np.dtype]]:
    """The byte order, the vertices, the elements before them, and the type of a row of each."""
    order, elements = _elements(lines)
    place = [element.name for element in elements].index("vertex")
    upto = elements[: place + 1]
    if any(element.has_list for element in upto):
        raise ValueError("list")
    if not {"x", "y", "z"} <= set(dict(elements[place].properties)):
        raise ValueError("vertex")
    types = [
        np.dtype([(name, f"{order or '<'}{kind}") for name, kind in element.properties])
        for element in upto
    ]
    return order, elements[place], elements[:place], types


def _elements(lines: Sequence[str]) -> tuple[str, list[_Element]]:
    """The byte order, "" for text, and the elements of a PLY header; ValueError where it is none.

    A property that comes twice is a ValueError of numpy's.
    """
    if lines[0] != "ply":
        raise ValueError(lines[0])
    order: str | None = None
    elements: list[_Element] = []
    for words in map(str.split, lines[1:]):
        match words:
            case ["format", form, *_]:
                order = _PLY_ORDERS[form]
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


def _numbers(path: Path, text: bytes, rows: int, width: int, first: int = 0) -> np.ndarray:
    """(rows, width) numbers from words, of which so many come first and others may follow."""
    wanted = first + rows * width
    words = text.split(None, wanted) if wanted <= len(text) else []
    if len(words) < wanted:
        raise DataError(
            f"{path}: its header claims {rows} points of {width} numbers, and fewer follow; the "
            "file is truncated or damaged"
        )
    try:
        values = [float(word) for word in words[first:wanted]]
    except ValueError:
        raise DataError(f"{path}: holds words among its numbers") from None
    return np.array(values, dtype=np.float64).reshape(rows, width)


def _rows(path: Path, content: bytes, row: np.dtype, count: int, start: int) -> np.ndarray:
    """Return (count,) rows of a structured type."""
    if start + count * row.itemsize > len(content):
        raise DataError(
            f"{path}: its header claims {count} points of {row.itemsize} bytes, and "
            f"{max(len(content) - start, 0)} bytes follow; the file is truncated or damaged"
        )
    return np.frombuffer(content, row, count, start) if count else np.zeros(0, row)


def _decompressed(path: Path, content: bytes, points: int, row: np.dtype) -> list[np.ndarray]:
    """Return the first column of each field; a compressed PCD keeps field after field."""
    packed, size = struct.unpack("<II", content[:8]) if len(content) >= 8 else (0, 0)
    known = size == points * row.itemsize and 8 + packed <= len(content)
    if not known or size > packed * _LZF_RATIO:
        raise DataError(f"{path}: its compressed points do not fit its header; it is damaged")
    unpacked = np.zeros(size, dtype=np.uint8)
    source = np.frombuffer(content, np.uint8, packed, 8) if packed else unpacked
    from curate.datasets.formats.lzf import unpack

    if unpack(source, unpacked) != size:
        raise DataError(f"{path}: its compressed points are damaged")
    fields, start = [], 0
    for name in row.names or ():
        kind = row[name]
        end = start + points * kind.itemsize
        fields.append(unpacked[start:end].view(kind.base).reshape(points, *kind.shape)[:, 0])
        start = end
    return fields
