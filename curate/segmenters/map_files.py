"""Files of semantic maps: PNG with class ids, colours or a palette, and NumPy arrays.

OpenCV replaces the indices of a palette by its colours, and scales grey values of fewer than 8 bits
to 0..255. In a semantic map the indices and the values are the class ids. So a PNG with a palette
is decoded as a grey image of its indices, and the scaling is undone.
"""

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from curate.datasets.formats.images import (
    MAX_PIXELS,
    PNG_SIGNATURE,
    PNG_START,
    decode_content,
    read_bytes,
)
from curate.errors import DataError, one_line

_GREY, _PALETTE, _GREY_ALPHA = 0, 3, 4  # PNG's colour types
_DEPTH_AT, _TYPE_AT = 24, 25  # in the file
_CHUNK = struct.Struct(">I4s")
_NPY_HEADERS = {
    True: np.lib.format.read_array_header_1_0,
    False: np.lib.format.read_array_header_2_0,
}


@dataclass(frozen=True)
class MapFile:
    """The content of a map's file.

    Attributes:
        values: (h, w) integers, or (h, w, 3) uint8 RGB, or (h, w, 4) with opacity.
        palette: (n, 3) uint8 RGB, the colour of each value; None if the file has no palette.
    """

    values: np.ndarray
    palette: np.ndarray | None = None


def read_map(path: Path) -> MapFile:
    """Return the content of a PNG or .npy file.

    Raises:
        DataError: if the file is missing, damaged, or in a format that changes values.
    """
    content = read_bytes(path)
    if path.suffix.lower() == ".npy":
        return MapFile(_array(path, content))
    if not content.startswith(PNG_START) or len(content) <= _TYPE_AT:
        decode_content(content, path, cv2.IMREAD_UNCHANGED)
        raise DataError(
            f"{path}: a JPEG changes the values of a map; save the class ids as PNG or .npy"
        )
    depth, colour_type = content[_DEPTH_AT], content[_TYPE_AT]
    palette = None
    if colour_type == _PALETTE:
        palette = _palette(content)
        content = _as_grey(content)
    values = decode_content(content, path, cv2.IMREAD_UNCHANGED)
    if values.ndim == 3 and colour_type == _GREY_ALPHA:
        values = values[:, :, 0]
    elif values.ndim == 3:
        code = cv2.COLOR_BGRA2RGBA if values.shape[2] == 4 else cv2.COLOR_BGR2RGB
        values = cv2.cvtColor(values, code)
    if colour_type in {_GREY, _PALETTE} and depth < 8:
        values = values // np.uint8(255 // ((1 << depth) - 1))
    if palette is not None and values.max(initial=0) >= len(palette):
        raise DataError(
            f"{path}: contains value {values.max()}, but its palette has {len(palette)} colours"
        )
    return MapFile(values, palette)


def _array(path: Path, content: bytes) -> np.ndarray:
    """Return the (h, w) integers of a .npy file."""
    stream = io.BytesIO(content)
    try:
        is_first = np.lib.format.read_magic(stream) == (1, 0)
        shape, _, kind = _NPY_HEADERS[is_first](stream)
        claimed = int(np.prod(shape, dtype=object)) * kind.itemsize
        if len(shape) != 2 or kind.kind not in "iub" or not 0 < claimed <= len(content):
            raise DataError(
                f"{path}: contains {kind}{list(shape)}; expected integers [height, width] of at "
                f"most {MAX_PIXELS} pixels"
            )
        stream.seek(0)
        values: np.ndarray = np.lib.format.read_array(stream, allow_pickle=False)
    except (ValueError, TypeError, OverflowError, SyntaxError) as error:
        raise DataError(f"{path}: not a readable .npy file: {one_line(error, 200)}") from None
    return values


def _chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield type and content of the chunks of a PNG that are complete."""
    offset = len(PNG_SIGNATURE)
    while offset + _CHUNK.size <= len(content):
        length, kind = _CHUNK.unpack_from(content, offset)
        offset += _CHUNK.size
        yield kind, content[offset : offset + length]
        offset += length + 4


def _palette(content: bytes) -> np.ndarray:
    """Return the (n, 3) colours of a PNG's palette."""
    found = next((part for kind, part in _chunks(content) if kind == b"PLTE"), b"")
    return np.frombuffer(found[: len(found) // 3 * 3], np.uint8).reshape(-1, 3)


def _as_grey(content: bytes) -> bytes:
    """Return a PNG with a palette as a grey one, with the indices as values.

    Both store a row in the same way; only the colour type and the chunks of colours differ.
    """
    parts = [PNG_SIGNATURE]
    for kind, part in _chunks(content):
        if kind in {b"PLTE", b"tRNS", b"bKGD", b"hIST", b"sBIT"}:
            continue
        written = part[:9] + bytes([_GREY]) + part[10:] if kind == b"IHDR" else part
        checksum = struct.pack(">I", zlib.crc32(kind + written))
        parts += [_CHUNK.pack(len(written), kind), written, checksum]
    return b"".join(parts)
