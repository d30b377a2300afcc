"""Images from files: pixels, or only the size, without trusting a damaged file."""

import struct
from pathlib import Path

import cv2
import numpy as np

from curate.errors import DataError

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_HEADER_BYTES = 24  # signature, length and name of IHDR, width, height
PNG_END = b"\x00\x00\x00\x00IEND\xaeB`\x82"


def read_image(path: Path) -> np.ndarray:
    """The (height, width, 3) uint8 RGB pixels of an image file.

    Raises:
        DataError: the file is missing, truncated or no image.
    """
    return cv2.cvtColor(decode_image(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def read_image_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels; of a PNG only the header is read.

    Raises:
        DataError: the file is missing or no image.
    """
    header = _read_bytes(path, PNG_HEADER_BYTES)
    if len(header) == PNG_HEADER_BYTES and header.startswith(PNG_SIGNATURE + b"\0\0\0\rIHDR"):
        width, height = struct.unpack(">II", header[16:])
        return int(width), int(height)
    height, width = decode_image(path, cv2.IMREAD_COLOR).shape[:2]
    return width, height


def read_sized_image(path: Path, *, pixels: bool) -> tuple[tuple[int, int], np.ndarray | None]:
    """(width, height) of an image file, and as `read_image` its pixels where they are wanted.

    Raises:
        DataError: the file is missing, truncated or no image.
    """
    if not pixels:
        return read_image_size(path), None
    image = read_image(path)
    height, width = image.shape[:2]
    return (width, height), image


def decode_image(path: Path, mode: int) -> np.ndarray:
    """The pixels of an image file as OpenCV decodes them under `mode` (cv2.IMREAD_...).

    Raises:
        DataError: the file is missing, truncated or no image.
    """
    content = _read_bytes(path)
    if content.startswith(PNG_SIGNATURE) and PNG_END not in content:
        raise DataError(f"{path}: the PNG ends before its end mark; fetch the file again")
    # OpenCV asserts that the buffer is not empty, and answers None to what it cannot decode.
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), mode) if content else None
    if pixels is None:
        raise DataError(f"{path}: no readable image ({len(content)} bytes); fetch the file again")
    return pixels


def _read_bytes(path: Path, limit: int = -1) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(limit)
    except FileNotFoundError:
        raise DataError(f"{path}: no such image file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
