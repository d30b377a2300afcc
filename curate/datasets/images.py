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
    return np.ascontiguousarray(decode(path, cv2.IMREAD_COLOR)[:, :, ::-1])


def read_image_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels; of a PNG only the header is read.

    Raises:
        DataError: the file is missing or no image.
    """
    with _opened(path) as file:
        header = file.read(PNG_HEADER_BYTES)
    if len(header) == PNG_HEADER_BYTES and header.startswith(PNG_SIGNATURE + b"\0\0\0\rIHDR"):
        width, height = struct.unpack(">II", header[16:])
        return int(width), int(height)
    height, width = decode(path, cv2.IMREAD_COLOR).shape[:2]
    return width, height


def decode(path: Path, mode: int) -> np.ndarray:
    """The pixels of an image file as OpenCV decodes them under `mode`.

    Raises:
        DataError: the file is missing, truncated or no image.
    """
    ...
