"""Point clouds in PCD and PLY: every variant of both, and invalid headers."""

import struct
import warnings
from pathlib import Path

import numpy as np
import pytest

from curate.datasets.formats.clouds import read_cloud
from curate.datasets.formats.point_layout import PointLayout
from curate.errors import DataError

POINTS = np.random.default_rng(0).uniform(-50, 50, (40, 4)).astype(np.float32)
POINTS[:, 3] = np.linspace(0, 1, 40)
PCD = """# .PCD v0.7
VERSION 0.7
FIELDS x y normal z intensity ring
SIZE 4 4 4 4 4 2
TYPE F F F F F U
COUNT 1 1 3 1 1 1
WIDTH 20
HEIGHT 2
VIEWPOINT 0 0 0 1 0 0 0
POINTS 40
DATA {form}
"""
TYPE = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("n", "<f4", 3), ("z", "<f4"), ("i", "<f4"), ("r", "<u2")]
)


def rows() -> np.ndarray:
    """Return the points with extra fields between the coordinates."""
    table = np.zeros(len(POINTS), TYPE)
    for name, column in zip("xyzi", POINTS.T, strict=True):
        table[name] = column
    table["n"], table["r"] = 7, 9
    return table


def packed(content: bytes) -> bytes:
    """Return LZF with literals, and one repetition if the content ends in a run of zeros."""
    run = len(content) - len(content.rstrip(b"\0"))
    run = min(run - 1, 264) if run > 4 else 0
    literal = content[: len(content) - run]
    out = b"".join(
        bytes([len(literal[i : i + 32]) - 1]) + literal[i : i + 32]
        for i in range(0, len(literal), 32)
    )
    return out + (bytes([7 << 5, run - 9, 0]) if run >= 9 else b"")


def test_pcd_as_text(tmp_path: Path) -> None:
    lines = [f"{x!r} {y!r} 7 7 7 {z!r} {i!r} 9" for x, y, z, i in POINTS.tolist()]
    (tmp_path / "a.pcd").write_text(PCD.format(form="ascii") + "\n".join(lines) + "\n")
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.pcd"), POINTS)


def test_pcd_as_binary(tmp_path: Path) -> None:
    """Row after row."""
    content = PCD.format(form="binary").encode() + rows().tobytes()
    (tmp_path / "a.pcd").write_bytes(content)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.pcd"), POINTS)
    (tmp_path / "a.pcd").write_bytes(content[:-1])
    with pytest.raises(DataError, match=r"claims 40 points .* truncated"):
        read_cloud(tmp_path / "a.pcd")


def test_pcd_as_compressed_binary(tmp_path: Path) -> None:
    """Field after field, literals and repetitions."""
    table = rows()
    table["r"] = 0
    plain = b"".join(table[name].tobytes() for name in TYPE.names)
    content = packed(plain)
    assert len(content) < len(plain) + len(plain) // 32
    head = PCD.format(form="binary_compressed").encode()
    whole = head + struct.pack("<II", len(content), len(plain)) + content
    (tmp_path / "a.pcd").write_bytes(whole)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.pcd"), POINTS)
    for damaged in (
        whole[:-3],
        head + struct.pack("<II", len(content), 2**32 - 1) + content,
        head + struct.pack("<II", len(content), len(plain)) + b"\xff" * len(content),
        head,
    ):
        (tmp_path / "a.pcd").write_bytes(damaged)
        with pytest.raises(DataError, match="compressed points"):
            read_cloud(tmp_path / "a.pcd")


@pytest.mark.parametrize("order", ["<", ">"])
def test_ply_as_binary(tmp_path: Path, order: str) -> None:
    """In both byte orders, with an element before the vertices and properties of other types."""
    kind = [("x", "f8"), ("r", "u1"), ("y", "f8"), ("z", "f8"), ("intensity", "f4")]
    table = np.zeros(40, [(name, order + of) for name, of in kind])
    for name, column in zip(("x", "y", "z", "intensity"), POINTS.T, strict=True):
        table[name] = column
    form = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    types = {"f8": "double", "u1": "uchar", "f4": "float32"}
    head = f"ply\nformat {form} 1.0\ncomment made\nelement camera 2\nproperty int id\n"
    head += "element vertex 40\n" + "".join(f"property {types[of]} {name}\n" for name, of in kind)
    head += "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_bytes(head.encode() + bytes(8) + table.tobytes())
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply"), POINTS)


@pytest.mark.parametrize(
    "claim",
    ["element vertex 999999999999", "element vertex 41", "element vertex -1", "element x 1"],
)
def test_a_header_that_claims_too_much_is_rejected_without_allocating(
    tmp_path: Path, claim: str
) -> None:
    """It is compared with the size of the file."""
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    for form in ("ascii", "binary_little_endian"):
        head = f"ply\nformat {form} 1.0\n{claim}\n{names}end_header\n".encode()
        body = b"1 2 3 0.5\n" * 40 if form == "ascii" else POINTS.tobytes()
        (tmp_path / "a.ply").write_bytes(head + body)
        with pytest.raises(DataError, match=r"a\.ply"):
            read_cloud(tmp_path / "a.ply")


def test_a_point_beyond_any_lidar_range_is_rejected(tmp_path: Path) -> None:
    """Grids over the points would fill the memory; map coordinates are not LiDAR coordinates."""
    points = POINTS.copy()
    points[3, 0] = 4.5e6
    np.save(tmp_path / "a.npy", points)
    with pytest.raises(DataError, match=r"point 3 is 4\.5e\+06 m away"):
        read_cloud(tmp_path / "a.npy")
    points[:, 1] += 4.5e6
    np.save(tmp_path / "a.npy", points)
    with pytest.raises(DataError, match=r"most points are 4\.5e\+06 m away; .* subtract its posit"):
        read_cloud(tmp_path / "a.npy")


def write_npy(path: Path, shape: str) -> Path:
    """Write the points with a header that claims this shape."""
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    path.write_bytes(
        b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + header.encode() + POINTS.tobytes()
    )
    return path


def test_long_integers_of_python_2_are_read(tmp_path: Path) -> None:
    """Without a message."""
    np.testing.assert_array_equal(read_cloud(write_npy(tmp_path / "a.npy", "(40L, 4L)")), POINTS)


def test_a_damaged_header_gives_one_error_and_no_warning(tmp_path: Path) -> None:
    """Python warns of a number directly followed by a word."""
    path = write_npy(tmp_path / "a.npy", "(1and 40, 4)")
    with warnings.catch_warnings(record=True) as recorded:
        warnings.simplefilter("always")
        with pytest.raises(DataError, match=r"a\.npy: not a readable"):
            read_cloud(path)
    assert not recorded


def write_pcd(path: Path, fields: str, values: bytes, **entries: str) -> Path:
    """Write a binary PCD of two points.

    Args:
        path: the file.
        fields: name, type with size and count of each field, such as "x F4 1, _ U1 4".
        values: content of the points.
        entries: further or other entries of the header.
    """
    parts = [part.split() for part in fields.split(", ")]
    header = {
        "VERSION": ".7",
        "FIELDS": " ".join(name for name, _, _ in parts),
        "SIZE": " ".join(kind[1] for _, kind, _ in parts),
        "TYPE": " ".join(kind[0] for _, kind, _ in parts),
        "COUNT": " ".join(count for _, _, count in parts),
        "WIDTH": "2",
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": "2",
        **entries,
        "DATA": "binary",
    }
    lines = [f"{key} {value}" for key, value in header.items() if value]
    path.write_bytes("\n".join(["# .PCD v.7", *lines, ""]).encode() + values)
    return path


TWO = np.array([[4, 1, -1, 0.5], [8, -2, -1.5, 0.25]], dtype=np.float32)


def test_padding_takes_the_bytes_of_its_count(tmp_path: Path) -> None:
    """Padding of four, no and three bytes, as in clouds that ROS' drivers record."""
    fields = "x F4 1, y F4 1, z F4 1, _ U1 4, intensity F4 1, _ U1 0, t F8 1, _ U1 3"
    rows = [struct.pack("<3f4xfd3x", *point, 9.5) for point in TWO.tolist()]
    path = write_pcd(tmp_path / "a.pcd", fields, b"".join(rows))
    np.testing.assert_array_equal(read_cloud(path), TWO)
    text = path.read_bytes().partition(b"DATA")[0].decode() + "DATA ascii\n"
    lines = [f"{x} {y} {z} 0 0 0 0 {i} 9.5 0 0 0" for x, y, z, i in TWO.tolist()]
    path.write_text(text + "\n".join(lines) + "\n")
    np.testing.assert_array_equal(read_cloud(path), TWO)
    content = b"".join(column.tobytes() for column in TWO[:, :3].T) + bytes(8)
    content += TWO[:, 3].tobytes() + bytes(16 + 6)
    literal = packed(content)
    head = text.replace("ascii", "binary_compressed").encode()
    path.write_bytes(head + struct.pack("<II", len(literal), len(content)) + literal)
    np.testing.assert_array_equal(read_cloud(path), TWO)


@pytest.mark.parametrize("name", ["Intensity", "INTENSITY", "intensities", "reflectivity", "i"])
def test_the_intensity_is_found_by_its_usual_names(tmp_path: Path, name: str) -> None:
    """In every format with names."""
    path = write_pcd(tmp_path / "a.pcd", f"x F4 1, y F4 1, z F4 1, {name} F4 1", TWO.tobytes())
    np.testing.assert_array_equal(read_cloud(path), TWO)
    table = np.zeros(2, [("t", "f8"), (name, "f4"), ("z", "f8"), ("y", "f8"), ("x", "f8")])
    for field, column in zip(("x", "y", "z", name), TWO.T, strict=True):
        table[field] = column
    np.save(tmp_path / "a.npy", table)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npy"), TWO)
    np.save(tmp_path / "a.npy", table.reshape(2, 1))  # an organised cloud
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npy"), TWO)
    names = "".join(f"property double {axis}\n" for axis in "xyz")
    rows = "\n".join(" ".join(map(str, row)) for row in TWO.tolist())
    (tmp_path / "a.ply").write_text(
        f"ply\nformat ascii 1.0\ncomment Created by CloudCompare\nelement vertex 2\n{names}"
        f"property float scalar_{name}\nend_header\n{rows}\n"
    )
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply"), TWO)


def test_two_fields_that_may_be_the_intensity_are_rejected_by_name(tmp_path: Path) -> None:
    """Ouster's driver writes intensity and reflectivity."""
    fields = "x F4 1, y F4 1, z F4 1, intensity F4 1, reflectivity U2 1"
    rows = [struct.pack("<4fH", *point[:3], 700, 51 * k) for k, point in enumerate(TWO.tolist())]
    path = write_pcd(tmp_path / "a.pcd", fields, b"".join(rows))
    with pytest.raises(DataError, match=r"intensity and reflectivity may all be the intensity"):
        read_cloud(path)
    layout = PointLayout(intensity_field="reflectivity", intensity_scale=255)
    np.testing.assert_allclose(read_cloud(path, layout)[:, 3], [0, 0.2])


def test_headers_of_other_programs(tmp_path: Path) -> None:
    """CR LF, lower case, a byte order mark, COLUMNS, no POINTS, and comments of any language."""
    body = "\r\n".join(" ".join(map(str, row)) for row in TWO.tolist())
    head = "# Punktwolke für später\nversion .5\ncolumns x y z intensity\nsize 4 4 4 4\n"
    head += "type f f f f\ncount 1 1 1 1\nwidth 2\nheight 1\ndata ascii\n"
    content = "\ufeff" + head.replace("\n", "\r\n") + body
    (tmp_path / "a.pcd").write_bytes(content.encode())
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.pcd"), TWO)


def test_an_organised_cloud_has_points_without_return(tmp_path: Path) -> None:
    table = np.vstack([TWO, np.full((2, 4), np.nan, dtype=np.float32)])
    size = {"WIDTH": "2", "HEIGHT": "2", "POINTS": "4"}
    fields = "x F4 1, y F4 1, z F4 1, intensity F4 1"
    path = write_pcd(tmp_path / "a.pcd", fields, table.tobytes(), **size)
    np.testing.assert_array_equal(read_cloud(path), TWO)


def test_a_header_that_contradicts_itself_is_rejected(tmp_path: Path) -> None:
    fields = "x F4 1, y F4 1, z F4 1, intensity F4 1"
    path = write_pcd(tmp_path / "a.pcd", fields, TWO.tobytes(), HEIGHT="2")
    with pytest.raises(DataError, match=r"POINTS is 2, but WIDTH 2 times HEIGHT 2 is 4"):
        read_cloud(path)
    path = write_pcd(tmp_path / "a.pcd", fields, TWO.tobytes(), SIZE="4 4 4")
    with pytest.raises(DataError, match="values: FIELDS 4, SIZE 3, TYPE 4, COUNT 4"):
        read_cloud(path)
    path = write_pcd(tmp_path / "a.pcd", fields.replace("x", "range"), TWO.tobytes())
    with pytest.raises(DataError, match="no column x among range, y, z, intensity"):
        read_cloud(path)


def test_a_pose_of_the_sensor_is_logged_once_and_not_applied(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As other readers of PCD do; the calibration says where the LiDAR is."""
    fields = "x F4 1, y F4 1, z F4 1, intensity F4 1"
    for name in ("a.pcd", "b.pcd"):
        path = write_pcd(
            tmp_path / name, fields, TWO.tobytes(), VIEWPOINT="1 2 0.5 0.707 0 0 0.707"
        )
        np.testing.assert_array_equal(read_cloud(path), TWO)
    assert caplog.text.count("VIEWPOINT is 1 2 0.5 0.707 0 0 0.707 and is not applied") == 1
