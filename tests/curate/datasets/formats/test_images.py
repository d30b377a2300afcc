"""Image files."""

from itertools import product

import cv2
import numpy as np
import pytest

from curate.datasets.formats.images import decode_image, read_image, read_image_size
from curate.errors import DataError


@pytest.fixture
def pixels():
    """Return random RGB pixels."""
    return np.random.default_rng(0).integers(0, 255, (7, 11, 3), dtype=np.uint8)


def test_png_pixels_and_size(tmp_path, pixels):
    """RGB in, RGB out; the size is (width, height)."""
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), pixels[..., ::-1])
    np.testing.assert_array_equal(read_image(path), pixels)
    assert read_image_size(path) == (11, 7)


def test_class_ids_keep_their_values(tmp_path, pixels):
    """Pixels are not converted between modes."""
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), pixels[..., 0])
    np.testing.assert_array_equal(decode_image(path, cv2.IMREAD_UNCHANGED), pixels[..., 0])


@pytest.mark.parametrize(
    ("suffix", "kept"), [(".png", -5), *product((".png", ".jpg"), (0, 7, 20, 40))]
)
def test_truncated_files_are_rejected(tmp_path, pixels, suffix, kept):
    """However little is left of the file, the error is a DataError with its path."""
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), pixels)
    content = path.read_bytes()
    path.write_bytes(content[:kept])
    with pytest.raises(DataError, match=rf"a\{suffix}: "):
        read_image(path)


def test_missing_files_and_folders_are_rejected(tmp_path):
    """Neither raises an OSError."""
    with pytest.raises(DataError, match=r"a\.png: no such image file"):
        read_image_size(tmp_path / "a.png")
    with pytest.raises(DataError, match="cannot be read: Is a directory"):
        read_image(tmp_path)
