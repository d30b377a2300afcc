"""Points to voxels, as OpenPCDet does it on the CPU."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curate.detectors.openpcdet.schema import Data
from curate.shapes import Float32, Int


@dataclass(frozen=True)
class Voxels:
    """The voxels of a batch of frames, frame by frame, each in the order of its first points.

    Attributes:
        points: (n, points per voxel, 4) float32 x, y, z, intensity; zeros behind the last point.
        places: (n, 4) int64 frame and cell z, y, x.
        counts: (n,) int64 number of points.
        left_out: (frames,) int64 number of voxels beyond the cap.
    """

    points: Float32[np.ndarray, "n p 4"]
    places: Int[np.ndarray, "n 4"]
    counts: Int[np.ndarray, " n"]
    left_out: Int[np.ndarray, " frames"]


def make_voxels(
    sweeps: Sequence[Float32[np.ndarray, "_ 4"]], data: Data, *, training: bool = False
) -> Voxels:
    """Return the voxels of sweeps.

    Args:
        sweeps: (n, 4) points of each frame in the LiDAR frame.
        data: range, grid and caps.
        training: whether the cap of training applies instead of that of inference.
    """
    from curate.detectors.openpcdet.kernels import group_points

    caps = data.voxels.max_number_of_voxels
    parts = [
        group_points(
            np.ascontiguousarray(points, dtype=np.float32),
            np.array(data.point_cloud_range, dtype=np.float32).reshape(2, 3),
            np.array(data.voxels.voxel_size, dtype=np.float32),
            np.array(data.grid, dtype=np.int64),
            data.voxels.max_points_per_voxel,
            caps.train if training else caps.test,
        )
        for points in sweeps
    ]
    frames = [np.full(len(cells), frame) for frame, (_, cells, _, _) in enumerate(parts)]
    cells = np.concatenate([cells for _, cells, _, _ in parts])
    return Voxels(
        np.concatenate([points for points, _, _, _ in parts]),
        np.column_stack([np.concatenate(frames), cells]),
        np.concatenate([counts for _, _, counts, _ in parts]),
        np.array([left_out for _, _, _, left_out in parts]),
    )
