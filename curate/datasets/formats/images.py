"""Reader of PNG and JPEG images, or only of their size, that rejects damaged files."""

import struct
from pathlib import Path

import numpy as np

from curate.errors import ConfigError, DataError

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_START = PNG_SIGNATURE + b"\0\0\0\rIHDR"
PNG_HEADER_BYTES = 24  # PNG_START, width, height
_PNG_CHUNK = struct.Struct(">I4s")  # length and type; then follow the content and its checksum
_PNG_CHECKSUM_BYTES = 4
JPEG_START = b"\xff\xd8"
# JPEG's start-of-frame markers, which contain the size: C0 to CF without three other markers.
_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_MARKERS_WITHOUT_CONTENT = frozenset({0x01, *range(0xD0, 0xD9)})
# A header may claim any size, and decoders allocate that much memory.
MAX_PIXELS = 1 << 25


def read_image(path: Path) -> np.ndarray:
    """Return the (height, width, 3) uint8 RGB pixels of an image file.

    Raises:
        DataError: if the file is missing, truncated or not an image.
    """
    import cv2

    return cv2.cvtColor(decode_image(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def read_image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) in pixels; only the header of a PNG is read.

    Raises:
        DataError: if the file is missing or not an image.
    """
    header = read_bytes(path, PNG_HEADER_BYTES)
    if not header.startswith(PNG_START):
        header = read_bytes(path)
    return _claimed_size(header, path)


def read_sized_image(path: Path, *, pixels: bool) -> tuple[tuple[int, int], np.ndarray | None]:
    """Return (width, height) of an image file, and its pixels as in `read_image` if requested.

    Raises:
        DataError: if the file is missing, truncated or not an image.
    """
    if not pixels:
        return read_image_size(path), None
    image = read_image(path)
    height, width = image.shape[:2]
    return (width, height), image


def read_optional_image(
    path: Path | None, size: tuple[int, int] | None, *, pixels: bool
) -> tuple[tuple[int, int] | None, np.ndarray | None]:
    """Return size and pixels as `read_sized_image`; for no path, the given size and no pixels."""
    return (size, None) if path is None else read_sized_image(path, pixels=pixels)


def check_image_size(size: object, place: str) -> tuple[int, int]:
    """Return a size in a configuration, [width, height] in pixels, as a tuple.

    Raises:
        ConfigError: if it is not two positive integers; the message starts with the place.
    """
    match size:
        case [int(width), int(height)] if 0 < width <= MAX_PIXELS and 0 < height <= MAX_PIXELS:
            return width, height
    raise ConfigError(f"{place} is {size!r}, expected [width, height] in pixels")


def decode_image(path: Path, mode: int) -> np.ndarray:
    """Return the pixels of an image file, decoded by OpenCV with `mode` (cv2.IMREAD_...).

    Raises:
        DataError: if the file is missing, truncated, not a PNG or JPEG, or has more than
            `MAX_PIXELS` pixels.
    """
    return decode_content(read_bytes(path), path, mode)


def decode_content(content: bytes, path: Path, mode: int) -> np.ndarray:
    """Return the pixels of an image file with this content; see `decode_image`."""
    import cv2

    _claimed_size(content, path)
    if content.startswith(PNG_SIGNATURE) and not _has_end(content):
        raise DataError(f"{path}: the PNG is truncated (no end chunk); fetch the file again")
    try:
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), mode)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise _unreadable(content, path)
    return pixels


def _claimed_size(content: bytes, path: Path) -> tuple[int, int]:
    """Return (width, height) according to the header of a PNG or JPEG.

    Raises:
        DataError: if the content is neither, or the size is 0 or above `MAX_PIXELS`.
    """
    size = None
    if content.startswith(PNG_START) and len(content) >= PNG_HEADER_BYTES:
        size = struct.unpack(">II", content[16:PNG_HEADER_BYTES])
    elif content.startswith(JPEG_START):
        size = _jpeg_size(content)
    if size is None:
        raise _unreadable(content, path)
    width, height = map(int, size)
    if not 0 < width * height <= MAX_PIXELS:
        raise DataError(
            f"{path}: the header claims {width} x {height} pixels, supported are 1 to {MAX_PIXELS}"
        )
    return width, height


def _has_end(content: bytes) -> bool:
    """Return whether the chunks of a PNG reach the end chunk IEND within the file.

    This is checked first because decoders allocate the length that a chunk claims before they read
    it. A file is a signature and chunks of length, type, content and checksum:

        89 50 4E 47 0D 0A 1A 0A | 0000000D IHDR ... | 00001F40 IDAT ... | 00000000 IEND ...
    """
    offset = len(PNG_SIGNATURE)
    chunk_type = b""
    while chunk_type != b"IEND" and offset + _PNG_CHUNK.size <= len(content):
        length, chunk_type = _PNG_CHUNK.unpack_from(content, offset)
        offset += _PNG_CHUNK.size + length + _PNG_CHECKSUM_BYTES
    return chunk_type == b"IEND" and offset <= len(content)


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    """Return (width, height) from the first start-of-frame segment; None if there is none."""
    offset = len(JPEG_START)
    while offset + 9 <= len(content) and content[offset] == 0xFF:
        marker = content[offset + 1]
        if marker in _SIZE_MARKERS:
            height, width = struct.unpack(">HH", content[offset + 5 : offset + 9])
            return width, height
        if marker == 0xFF:
            offset += 1
        elif marker in _MARKERS_WITHOUT_CONTENT:
            offset += 2
        else:
            offset += 2 + int(struct.unpack(">H", content[offset + 2 : offset + 4])[0])
    return None


def _unreadable(content: bytes, path: Path) -> DataError:
    return DataError(
        f"{path}: not a readable PNG or JPEG image ({len(content)} bytes); fetch the file again"
    )


def read_bytes(path: Path, limit: int = -1) -> bytes:
    """Return the content of an image file, or its first `limit` bytes.

    Raises:
        DataError: if the file is missing or cannot be read.
    """
    try:
        with path.open("rb") as file:
            return file.read(limit)
    except FileNotFoundError:
        raise DataError(f"{path}: no such image file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
