"""The toy frames in the layouts of other datasets."""

from pathlib import Path

import numpy as np

from curate.datasets.kitti.dataset import KittiDataset
from support.toys import toy_calibration, write_toy_kitti

DRIVE = "2011_09_26_drive_0001_sync"


def _text(matrix: np.ndarray) -> str:
    return " ".join(f"{number!r}" for number in matrix.ravel().tolist())


def write_toy_raw(root: Path, frames: int = 4) -> None:
    """Write KITTI raw below ROOT: one drive of one day."""
    write_toy_kitti(root / "made", frames)
    drive = root / "2011_09_26" / DRIVE
    homes = {"velodyne": "velodyne_points/data", "image_2": "image_02/data", "label_2": "label_2"}
    for source, home in homes.items():
        (drive / home).mkdir(parents=True)
        for path in sorted((root / "made" / "training" / source).iterdir()):
            path.rename(drive / home / f"{int(path.stem):010d}{path.suffix}")
    calibration = toy_calibration()
    extrinsic = calibration.lidar_to_camera
    (drive.parent / "calib_velo_to_cam.txt").write_text(
        f"calib_time: 15-Mar-2012 11:37:16\nR: {_text(extrinsic[:3, :3])}\n"
        f"T: {_text(extrinsic[:3, 3])}\n"
    )
    (drive.parent / "calib_cam_to_cam.txt").write_text(
        f"R_rect_00: {_text(np.eye(3))}\nP_rect_02: {_text(calibration.projection)}\n"
    )


def write_toy_tracking(root: Path, frames: int = 4) -> None:
    """Write KITTI tracking below ROOT: the same frames in two sequences, half of them in each."""
    write_toy_kitti(root / "made", frames)
    made, home = root / "made" / "training", root / "training"
    labels: dict[str, list[str]] = {}
    for i in range(frames):
        sequence, number = f"{2 * i // frames:04d}", i % (frames // 2)
        for source, target in (("velodyne", "velodyne"), ("image_2", "image_02")):
            (home / target / sequence).mkdir(parents=True, exist_ok=True)
            (path,) = (made / source).glob(f"{i:06d}.*")
            path.rename(home / target / sequence / f"{number:06d}{path.suffix}")
        lines = (made / "label_2" / f"{i:06d}.txt").read_text().splitlines()
        labels.setdefault(sequence, []).extend(
            f"{number} {track} {_with_level(line)}" for track, line in enumerate(lines)
        )
    for folder in ("calib", "label_02"):
        (home / folder).mkdir()
    calibration = toy_calibration()
    for sequence, lines in labels.items():
        (home / "label_02" / f"{sequence}.txt").write_text("".join(f"{each}\n" for each in lines))
        (home / "calib" / f"{sequence}.txt").write_text(
            f"P2: {_text(calibration.projection)}\nR_rect {_text(np.eye(3))}\n"
            f"Tr_velo_cam {_text(calibration.lidar_to_camera[:3])}\n"
        )


def _with_level(line: str) -> str:
    """Return a label line with an integer level of truncation, as KITTI tracking has it."""
    category, truncated, *rest = line.split()
    return " ".join((category, str(int(float(truncated))), *rest))


def write_toy_folder(root: Path, frames: int = 4) -> None:
    """Write a plain folder, each frame's points in another format."""
    write_toy_kitti(root / "made", frames)
    made = KittiDataset(root / "made")
    for source, home in (("image_2", "camera"), ("label_2", "boxes")):
        (root / "made" / "training" / source).rename(root / home)
    (root / "lidar").mkdir()
    for i, name in enumerate(made.frame_ids()):
        source = root / "made" / "training" / "velodyne" / f"{name}.bin"
        points = np.fromfile(source, dtype=np.float32).reshape(-1, 4) * [1, 1, 1, 255]
        write_cloud(root / "lidar" / f"{name}{('.bin', '.npy', '.pcd', '.ply')[i % 4]}", points)
    calibration = toy_calibration()
    (root / "dataset.toml").write_text(
        'points = "lidar"\nimages = "camera"\nlabels = "boxes"\nintensity_scale = 255\n'
        f"[calibration]\nprojection = {calibration.projection.tolist()}\n"
        f"lidar_to_camera = {calibration.lidar_to_camera[:3].tolist()}\n"
    )


def write_cloud(path: Path, points: np.ndarray) -> None:
    """Write a file of (n, 4) points in the format of its suffix."""
    points = np.float32(points)
    rows = "\n".join(" ".join(map(repr, row)) for row in points.tolist())
    if path.suffix == ".bin":
        points.tofile(path)
    elif path.suffix == ".npy":
        np.save(path, points)
    elif path.suffix == ".pcd":
        path.write_bytes(
            b"VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
            + f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n".encode()
            + f"POINTS {len(points)}\nDATA binary\n".encode()
            + points.tobytes()
        )
    else:
        names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
        path.write_text(
            f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{names}end_header\n{rows}\n"
        )
