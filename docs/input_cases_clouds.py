"""Point clouds and images with variations; see `input_cases`."""

import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from curate.datasets.formats.clouds import read_cloud
from curate.datasets.formats.images import read_image
from curate.datasets.formats.point_layout import PointLayout
from docs.input_reader import Case, Content, Reader

POINTS = np.array([[10, 1, -1, 0.5], [20, -2, 0, 0.25], [30, 3, 1, 1]], dtype="<f4")
PIXELS = np.arange(40 * 120 * 3, dtype=np.uint32).reshape(40, 120, 3).astype(np.uint8)

_ROWS = "\n".join(" ".join(f"{number:g}" for number in row) for row in POINTS.tolist())
_PCD = (
    "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    "WIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\n"
)
_PCD_TEXT = f"{_PCD}DATA ascii\n{_ROWS}\n"
_PCD_BYTES = f"{_PCD}DATA binary\n".encode() + POINTS.tobytes()
_PLY = "ply\nformat {} 1.0\nelement vertex 3\n" + "".join(
    f"property float {name}\n" for name in ("x", "y", "z", "intensity")
)
_PLY_TEXT = f"{_PLY.format('ascii')}end_header\n{_ROWS}\n"
_SCALE = np.array([1, 1, 1, 255], dtype="<f4")
# A street: enough points to see that a file has another number of columns.
_STREET = np.column_stack(
    [np.linspace(5, 60, 60), np.linspace(-9, 9, 60), np.full(60, -1.7), np.linspace(0, 1, 60)]
).astype("<f4")


def encoded(pixels: np.ndarray, suffix: str = ".png") -> bytes:
    """Return the content of an image file."""
    return bytes(cv2.imencode(suffix, pixels)[1].tobytes())


def npy(table: Any) -> bytes:
    """Return the content of a .npy file."""
    buffer = io.BytesIO()
    np.save(buffer, table)
    return buffer.getvalue()


def _read(path: Path, **layout: Any) -> Any:
    return read_cloud(path, PointLayout(**layout))


def _with_nan(points: np.ndarray) -> np.ndarray:
    return np.vstack([points, np.full((1, 4), np.nan, dtype="<f4")])


def _wide(points: np.ndarray, columns: int) -> bytes:
    """Return rows with further columns: the ring, then the time in seconds."""
    more = [np.arange(len(points)) % 32, np.linspace(0, 0.1, len(points)), points[:, 3]]
    return np.column_stack([points, *more[: columns - 4]]).astype("<f4").tobytes()


def _named(names: Iterable[str]) -> np.ndarray:
    table = np.zeros(len(POINTS), dtype=[(name, "<f4") for name in names])
    for name, column in zip(table.dtype.names or (), POINTS.T, strict=True):
        table[name] = column
    return table


def _pcd(fields: str, sizes: str, types: str, counts: str, rows: bytes) -> bytes:
    header = _PCD.replace("x y z intensity", fields).replace("SIZE 4 4 4 4", f"SIZE {sizes}")
    header = header.replace("F F F F", types).replace("1 1 1 1", counts)
    return f"{header}DATA binary\n".encode() + rows


def _compressed() -> bytes:
    """Return a binary_compressed PCD file; LZF also allows runs that are not compressed."""
    content = POINTS.T.tobytes()
    runs = [content[i : i + 32] for i in range(0, len(content), 32)]
    packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
    sizes = np.array([len(packed), len(content)], dtype="<u4").tobytes()
    return f"{_PCD}DATA binary_compressed\n".encode() + sizes + packed


def _field(name: str) -> Content:
    return _PCD_BYTES.replace(b"intensity", name.encode())


_BOTH = _PCD_TEXT.replace("z intensity", "intensity reflectivity")
_DOUBLES = _pcd("x y z intensity", "8 8 8 8", "F F F F", "1 1 1 1", POINTS.astype("<f8").tobytes())
_PADDED = _pcd(
    "x y z _ intensity", "4 4 4 1 4", "F F F U F", "1 1 1 4 1",
    np.column_stack([POINTS[:, :3], np.zeros(3, "<f4"), POINTS[:, 3]]).tobytes(),
)  # fmt: skip
_NO_BYTES = _pcd("x y z normal intensity", "4 4 4 4 4", "F F F F F", "1 1 1 0 1", POINTS.tobytes())

CLOUDS = (
    Reader(
        "Point clouds: .bin",
        "Rows of float32, little-endian: x, y, z, intensity. Settings such as `columns` are those "
        "of `[dataset]`.",
        "000001.bin", _read, POINTS.tobytes(),
        [
            Case("an empty file: no points", b"", other=True),
            Case("points that are NaN are dropped", _with_nan(POINTS).tobytes()),
            *(
                case
                for columns in (5, 6, 7)
                for case in (
                    Case(f"{columns} columns without `columns`", _wide(_STREET, columns)),
                    Case(f"{columns} columns with `columns = {columns}`", _wide(POINTS, columns),
                         options={"columns": columns}),
                )
            ),
            Case("columns in another order with `column_names`", POINTS[:, ::-1].tobytes(),
                 options={"column_names": ("intensity", "z", "y", "x")}),
            Case("`columns` does not fit the file", POINTS.tobytes(), options={"columns": 5}),
            Case("intensities up to 255", (POINTS * _SCALE).tobytes()),
            Case("intensities up to 255 with `intensity_scale = 255`", (POINTS * _SCALE).tobytes(),
                 options={"intensity_scale": 255.0}),
            Case("negative intensities", (POINTS * np.float32([1, 1, 1, -1])).tobytes()),
            Case("the file ends within a point", POINTS.tobytes()[:-3]),
            Case("in millimetres", (POINTS * [1000, 1000, 1000, 1]).astype("<f4").tobytes()),
            Case("another suffix", POINTS.tobytes(), name="000001.dat"),
        ],
    ),
    Reader(
        "Point clouds: .npy", "An array (n, 4) of numbers, as `numpy.save` writes it.",
        "000001.npy", _read, npy(POINTS),
        [
            Case("float64", npy(POINTS.astype(np.float64))),
            Case("big-endian", npy(POINTS.astype(">f4"))),
            Case("columns first in memory", npy(np.asfortranarray(POINTS))),
            Case("named fields: x, y, z, intensity", npy(_named(["x", "y", "z", "intensity"]))),
            Case("named fields without x", npy(_named(["u", "y", "z", "intensity"]))),
            Case("points that are NaN are dropped", npy(_with_nan(POINTS))),
            Case("no points", npy(POINTS[:0]), other=True),
            Case("five columns without `columns = 5`", npy(np.hstack([POINTS, POINTS[:, :1]]))),
            Case("five columns with `columns = 5`", npy(np.hstack([POINTS, POINTS[:, :1]])),
                 options={"columns": 5}),
            Case("one dimension", npy(POINTS.ravel())),
            Case("an array of objects", npy(np.array([{}, {}], dtype=object))),
            Case("the file ends early", npy(POINTS)[:-8]),
        ],
    ),
    Reader(
        "Point clouds: .pcd", "PCD 0.7: text, binary or binary_compressed.",
        "000001.pcd", _read, _PCD_BYTES,
        [
            Case("text", _PCD_TEXT),
            Case("Windows line ends in a text file", _PCD_TEXT.replace("\n", "\r\n")),
            Case("Windows line ends in the header of a binary file",
                 f"{_PCD}DATA binary\n".replace("\n", "\r\n").encode() + POINTS.tobytes()),
            Case("binary_compressed", _compressed()),
            Case("double precision", _DOUBLES),
            Case("a comment before the header", b"# .PCD v.7\n" + _PCD_BYTES),
            *(
                Case(f"the intensity is called {name}", _field(name))
                for name in ("Intensity", "reflectivity", "i", "scalar_Intensity")
            ),
            Case("X, Y and Z in capital letters", _PCD_BYTES.replace(b"x y z", b"X Y Z")),
            Case("padding: a field `_`", _PADDED),
            Case("padding: a field with COUNT 0", _NO_BYTES),
            Case("no intensity: it is 0", _field("ring"), other=True),
            Case("two fields that may be the intensity", _BOTH.replace("x y", "x y z").replace(
                "4 4 4 4", "4 4 4 4 4").replace("F F F F", "F F F F F").replace(
                "1 1 1 1", "1 1 1 1 1")),
            Case("two of them with `intensity_field`", _pcd(
                "x y z intensity reflectivity", "4 4 4 4 4", "F F F F F", "1 1 1 1 1",
                np.column_stack([POINTS, POINTS[:, :1]]).tobytes()),
                options={"intensity_field": "intensity"}),
            Case("organised: WIDTH x HEIGHT", _PCD_BYTES.replace(
                b"WIDTH 3\nHEIGHT 1", b"WIDTH 1\nHEIGHT 3")),
            Case("WIDTH x HEIGHT is not POINTS", _PCD_BYTES.replace(b"WIDTH 3", b"WIDTH 2")),
            Case("another VIEWPOINT is not applied, with a warning", _PCD_BYTES.replace(
                b"VIEWPOINT 0 0 0", b"VIEWPOINT 1 2 3")),
            Case("fewer values in SIZE than in FIELDS", _PCD_BYTES.replace(b"SIZE 4 4", b"SIZE 4")),
            Case("no field x", _PCD_BYTES.replace(b"FIELDS x", b"FIELDS u")),
            Case("no line DATA", _PCD),
            Case("the file ends early", _PCD_BYTES[:-4]),
        ],
    ),
    Reader(
        "Point clouds: .ply", "PLY 1.0: text, or binary of either byte order.",
        "000001.ply", _read, _PLY_TEXT,
        [
            Case("binary, little-endian", f"{_PLY.format('binary_little_endian')}end_header\n"
                 .encode() + POINTS.tobytes()),
            Case("binary, big-endian", f"{_PLY.format('binary_big_endian')}end_header\n".encode()
                 + POINTS.astype(">f4").tobytes()),
            Case("the intensity is called scalar_Intensity", _PLY_TEXT.replace(
                "intensity", "scalar_Intensity")),
            Case("intensities up to 255", _PLY_TEXT.replace(" 0.25\n", " 255\n")),
            Case("faces after the points", _PLY_TEXT.replace(
                "end_header", "element face 1\nproperty list uchar int vertex_indices\nend_header")
                + "3 0 1 2\n"),
            Case("Windows line ends in a text file", _PLY_TEXT.replace("\n", "\r\n")),
            Case("a comment in the header", _PLY_TEXT.replace("element", "comment a\nelement")),
            Case("no property x", _PLY_TEXT.replace("float x", "float u")),
            Case("no end_header", _PLY_TEXT.replace("end_header\n", "")),
            Case("the file ends early", _PLY_TEXT[:-12]),
        ],
    ),
    Reader(
        "Images", "PNG or JPEG, whatever the suffix.", "000001.png", read_image, encoded(PIXELS),
        [
            Case("grey", encoded(PIXELS[..., 0]), other=True),
            Case("with transparency", encoded(np.dstack([PIXELS, PIXELS[..., :1]]))),
            Case("16 bits per channel", encoded(PIXELS.astype(np.uint16) * 257)),
            Case("a JPEG file named .png", encoded(PIXELS, ".jpg"), other=True),
            Case("a PNG file named .JPG", encoded(PIXELS), name="000001.JPG"),
            Case("the file ends early", encoded(PIXELS)[:-40]),
            Case("an empty file", b""),
            Case("another format", b"GIF89a" + bytes(40)),
        ],
    ),
)  # fmt: skip
