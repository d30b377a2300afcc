"""Small files that claim, or expand to, far more than fits into memory."""

import io
import pickle
import sqlite3
import struct
import zlib
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path

import numpy as np
from fuzzing.targets import TARGETS


def _png(path: Path) -> None:
    """Return a PNG of a gigapixel of zeros, compressed to kilobytes."""
    width, height = 40_000, 25_000

    def chunk(kind: bytes, content: bytes) -> bytes:
        check = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)

    packer = zlib.compressobj(9)
    row = bytes(1 + 3 * width)
    packed = b"".join(packer.compress(row) for _ in range(height // 50)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")
    )


def _png_piece(path: Path) -> None:
    """Return a PNG with a pixel chunk of this claimed length."""
    TARGETS["png"].write(path)
    content = bytearray(path.read_bytes())
    at = content.index(b"IDAT")
    content[at - 4 : at] = struct.pack(">I", 4_000_000_000)
    path.write_bytes(content)


def _jpeg(path: Path) -> None:
    TARGETS["jpg"].write(path)
    content = bytearray(path.read_bytes())
    at = content.index(b"\xff\xc0")
    content[at + 5 : at + 9] = struct.pack(">HH", 65_000, 65_000)
    path.write_bytes(content)


def _npy(path: Path) -> None:
    buffer = io.BytesIO()
    header = {"descr": "<f4", "fortran_order": False, "shape": (4_000_000_000, 4)}
    np.lib.format.write_array_header_1_0(buffer, header)
    path.write_bytes(buffer.getvalue() + bytes(64))


def _npz(path: Path) -> None:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, a=np.zeros((30_000_000, 4), np.float32))
    path.write_bytes(buffer.getvalue())


def _claims(name: str, old: bytes, new: bytes) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        TARGETS[name].write(path)
        content = path.read_bytes()
        assert old in content
        path.write_bytes(content.replace(old, new))

    return write


def _far_point(path: Path) -> None:
    np.float32([[1e9, -1e9, 0, 0], [1, 2, 3, 0]]).tofile(path)


def _laughs(path: Path) -> None:
    """Return a list of ten lists of ten lists ..., each the same."""
    boxes = [1.0] * 10
    for _ in range(30):
        boxes = [boxes] * 10
    entry = {"frame_id": boxes, "boxes_lidar": boxes, "score": [1.0], "name": ["Car"]}
    path.write_bytes(pickle.dumps([entry]))


def _called(name: bytes) -> Callable[[Path], None]:
    """Return a pickle of builtins.NAME(60_000_000_000), which allocates that many zeros."""
    call = b"\x80\x04c" + name + b"\n\x8a\x08" + struct.pack("<q", 60_000_000_000) + b"\x85R."
    return lambda path: path.write_bytes(call) and None


def _memo(path: Path) -> None:
    """Return a pickle with memo entry number two billion."""
    path.write_bytes(b"\x80\x02]r" + struct.pack("<I", 2_000_000_000) + b".")


def _byte_array(path: Path) -> None:
    path.write_bytes(b"\x80\x05\x96" + struct.pack("<Q", 60_000_000_000) + b"abc.")


def _endless_view(path: Path) -> None:
    """Return a label file with an endless view in place of the labels."""
    TARGETS["label file"].write(path)
    with closing(sqlite3.connect(path)) as file:
        names = [row[1] for row in file.execute("PRAGMA table_xinfo(label)")]
        file.executescript("PRAGMA foreign_keys = OFF; DROP VIEW weighted_labels; DROP TABLE label")
        rows = ", ".join("'a'" if name in ("frame", "category") else "1.0" for name in names)
        file.execute(
            f"CREATE VIEW label ({', '.join(names)}) AS WITH RECURSIVE n(i) AS "
            f"(SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT {rows} FROM n"
        )
        file.commit()


def _wide_column(path: Path) -> None:
    """Return a label file with a generated column of half a gigabyte."""
    TARGETS["label file"].write(path)
    with closing(sqlite3.connect(path)) as file:
        file.executescript(
            "PRAGMA foreign_keys = OFF; DROP TABLE meta; CREATE TABLE meta (key TEXT, "
            "value TEXT GENERATED ALWAYS AS (hex(zeroblob(250000000))) VIRTUAL);"
            "INSERT INTO meta (key) VALUES ('format_version')"
        )


def _many_boxes(path: Path) -> None:
    """Return the same box three million times."""
    from pyarrow import parquet

    TARGETS["parquet"].write(path)
    rows = parquet.read_table(path).take(np.zeros(3_000_000, np.int64))
    parquet.write_table(rows, path, compression="zstd")


def _long_name(path: Path) -> None:
    """Return a frame name of 300 megabytes."""
    import pyarrow as pa
    from pyarrow import parquet

    TARGETS["parquet"].write(path)
    rows = parquet.read_table(path)
    names = pa.DictionaryArray.from_arrays(np.zeros(len(rows), np.int8), ["a" * 300_000_000])
    parquet.write_table(rows.set_column(0, "frame", names), path, compression="zstd")


def _safetensors(path: Path) -> None:
    path.write_bytes(struct.pack("<Q", 2**40) + b"{}")


def _dotted_key(path: Path) -> None:
    path.write_text(f"{'a.' * 15_000}a = 1\n")


def _dotted_heading(path: Path) -> None:
    path.write_text("[" + '"a" . ' * 15_000 + "a]\na = 1\n")


_VERTICES = b"element vertex 100"
_BOMBS: Mapping[str, tuple[str, Callable[[Path], None]]] = {
    "a png of a gigapixel": ("png", _png),
    "a png with a piece of four gigabytes": ("png", _png_piece),
    "a map with a piece of four gigabytes": ("saved map", _png_piece),
    "a jpeg of four gigapixels": ("jpg", _jpeg),
    "a map of a gigapixel": ("saved map", _png),
    "an npy of 64 gigabytes": ("npy", _npy),
    "an archive of zeros": ("npy", _npz),
    "a pcd of a billion points": ("pcd", _claims("pcd", b"POINTS 100", b"POINTS 4000000000")),
    "a pcd of text": ("pcd text", _claims("pcd text", b"POINTS 100", b"POINTS 4000000000")),
    "a pcd of wide fields": ("pcd", _claims("pcd", b"COUNT 1", b"COUNT 4000000000")),
    "a ply of a billion points": ("ply", _claims("ply", _VERTICES, _VERTICES + b"0000000")),
    "a ply of text": ("ply text", _claims("ply text", _VERTICES, _VERTICES + b"0000000")),
    "a point at the end of the world": ("velodyne", _far_point),
    "a billion laughs": ("pickle 5", _laughs),
    "bytearray of a number": ("pickle 2", _called(b"builtins\nbytearray")),
    "bytes of a number": ("pickle 2", _called(b"__builtin__\nbytes")),
    "a pickle's memo": ("pickle 2", _memo),
    "a pickle's bytearray": ("pickle 5", _byte_array),
    "labels without end": ("label file", _endless_view),
    "a cell of half a gigabyte": ("label file", _wide_column),
    "a checkpoint's header": ("checkpoint", _safetensors),
    "a box three million times": ("parquet", _many_boxes),
    "a name of 300 megabytes": ("parquet", _long_name),
    "a key of many parts": ("description", _dotted_key),
    "a heading of many parts": ("configuration", _dotted_heading),
}
# Formats of extras are included if the extra is installed.
BOMBS = {name: bomb for name, bomb in _BOMBS.items() if bomb[0] in TARGETS}
