"""Images from files: pixels, or only the size, without trusting a damaged file."""

import struct
from pathlib import Path

import numpy as np

from curate.errors import DataError

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_START = PNG_SIGNATURE + b"\0\0\0\rIHDR"
PNG_HEADER_BYTES = 24  # PNG_START, width, height
_PNG_CHUNK = struct.Struct(">I4s")  # length and kind, before the content and its checksum
_PNG_CHECK_BYTES = 4
JPEG_START = b"\xff\xd8"
# Markers of JPEG that tell the size: start of frame, without the three that mean other things.
_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_BARE_MARKERS = frozenset({0x01, *range(0xD0, 0xD9)})
# A header may claim any size, and decoders believe it.
MOST_PIXELS = 1 << 25


def read_image(path: Path) -> np.ndarray:
    """Return the (height, width, 3) uint8 RGB pixels of an image file.

    Raises:
        DataError: if the file is missing, truncated or no image.
    """
    import cv2

    return cv2.cvtColor(decode_image(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def read_image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) in pixels; of a PNG only the header is read.

    Raises:
        DataError: if the file is missing or no image.
    """
    header = _read_bytes(path, PNG_HEADER_BYTES)
    if not header.startswith(PNG_START):
        header = _read_bytes(path)
    return _claimed_size(header, path)


def read_sized_image(path: Path, *, pixels: bool) -> tuple[tuple[int, int], np.ndarray | None]:
    """(width, height) of an image file, and as `read_image` its pixels where they are wanted.

    Raises:
        DataError: if the file is missing, truncated or no image.
    """
    if not pixels:
        return read_image_size(path), None
    image = read_image(path)
    height, width = image.shape[:2]
    return (width, height), image


def decode_image(path: Path, mode: int) -> np.ndarray:
    """Return the pixels of an image file as OpenCV decodes them under `mode` (cv2.IMREAD_...).

    Raises:
        DataError: if the file is missing, truncated, no PNG or JPEG, or larger than `MOST_PIXELS`.
    """
    import cv2

    content = _read_bytes(path)
    _claimed_size(content, path)
    if content.startswith(PNG_SIGNATURE) and not _has_end(content):
        raise DataError(f"{path}: the PNG ends before its end mark; fetch the file again")
    try:
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), mode)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise _unreadable(content, path)
    return pixels


def _claimed_size(content: bytes, path: Path) -> tuple[int, int]:
    """(width, height) by the header of a PNG or JPEG; DataError where it is none, or absurd."""
    size = None
    if content.startswith(PNG_START) and len(content) >= PNG_HEADER_BYTES:
        size = struct.unpack(">II", content[16:PNG_HEADER_BYTES])
    elif content.startswith(JPEG_START):
        size = _jpeg_size(content)
    if size is None:
        raise _unreadable(content, path)
    width, height = map(int, size)
    if not 0 < width * height <= MOST_PIXELS:
        raise DataError(
            f"{path}: claims {width} x {height} pixels; images of up to {MOST_PIXELS} are read"
        )
    return width, height


def _has_end(content: bytes) -> bool:
    """Return whether a PNG's chunks lead to its end mark within the file.

    A decoder takes memory for as many bytes as a chunk claims before it reads the first.
    """
    at = len(PNG_SIGNATURE)
    kind = b""
    while kind != b"IEND" and at + _PNG_CHUNK.size <= len(content):
        length, kind = _PNG_CHUNK.unpack_from(content, at)
        at += _PNG_CHUNK.size + length + _PNG_CHECK_BYTES
    return kind == b"IEND" and at <= len(content)


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    """Return (width, height) by the first start of a frame; None where there is none."""
    at = len(JPEG_START)
    while at + 9 <= len(content) and content[at] == 0xFF:
        marker = content[at + 1]
        if marker in _SIZE_MARKERS:
            height, width = struct.unpack(">HH", content[at + 5 : at + 9])
            return width, height
        if marker == 0xFF:
            at += 1
        elif marker in _BARE_MARKERS:
            at += 2
        else:
            at += 2 + int(struct.unpack(">H", content[at + 2 : at + 4])[0])
    return None


def _unreadable(content: bytes, path: Path) -> DataError:
    return DataError(
        f"{path}: no readable image (PNG or JPEG, {len(content)} bytes); fetch the file again"
    )


def _read_bytes(path: Path, limit: int = -1) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(limit)
    except FileNotFoundError:
        raise DataError(f"{path}: no such image file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
