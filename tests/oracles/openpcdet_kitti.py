"""KITTI frames and result files as OpenPCDet reads and writes them.

Source: its calibration, its flag of points in the field of view, and its conversion of boxes for
KITTI's result files; written anew from the formulas, in single precision as there.
"""

from pathlib import Path

import numpy as np


class Calibration:
    """The matrices of a calibration file, by the number of the line: P2, -, R0_rect, Tr."""

    def __init__(self, path: Path) -> None:
        rows = [line.split()[1:] for line in path.read_text().splitlines()]
        self.projection = np.array(rows[2], np.float32).reshape(3, 4)
        self.rectification = np.array(rows[4], np.float32).reshape(3, 3)
        self.to_camera = np.array(rows[5], np.float32).reshape(3, 4)

    def rectified(self, points: np.ndarray) -> np.ndarray:
        """Return (n, 3) LiDAR points in the rectified camera frame."""
        return homogeneous(points) @ (self.to_camera.T @ self.rectification.T)

    def in_lidar(self, points: np.ndarray) -> np.ndarray:
        """Return (n, 3) points of the rectified camera frame in the LiDAR frame, by an inverse."""
        both = np.eye(4, dtype=np.float32)
        both[:3] = self.rectification @ self.to_camera
        return (homogeneous(points) @ np.linalg.inv(both.T))[:, :3]

    def in_view(self, points: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
        """Return (n,) whether LiDAR points are in front of the camera and within its image."""
        rectified = self.rectified(points)
        projected = homogeneous(rectified) @ self.projection.T
        u, v = (projected[:, :2] / rectified[:, 2:]).T
        depth = projected[:, 2] - self.projection[2, 3]
        width, height = image_size
        return (u >= 0) & (u < width) & (v >= 0) & (v < height) & (depth >= 0)


def homogeneous(points: np.ndarray) -> np.ndarray:
    """Return (n, 4) points with a one behind them."""
    return np.column_stack([points[:, :3], np.ones(len(points))]).astype(np.float32)


def write_results(
    path: Path, boxes: np.ndarray, scores: np.ndarray, names: np.ndarray, calibration: Calibration
) -> None:
    """Write the result file of a frame: bottom centres, and r = -heading - pi/2.

    Args:
        path: the file.
        boxes: (n, 7) in the LiDAR frame.
        scores: (n,).
        names: (n,).
        calibration: of the frame.
    """
    bottoms = calibration.rectified(boxes - np.outer(boxes[:, 5] / 2, [0, 0, 1, 0, 0, 0, 0]))
    lines = [
        f"{name} -1 -1 0.0000 0 0 50 50 {box[5]:.4f} {box[4]:.4f} {box[3]:.4f} "
        f"{' '.join(f'{number:.4f}' for number in bottom)} {-box[6] - np.pi / 2:.4f} {score:.4f}\n"
        for name, box, bottom, score in zip(names, boxes, bottoms, scores, strict=True)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(lines))
