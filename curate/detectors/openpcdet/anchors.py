"""Anchors and the code of a box relative to an anchor or a proposal.

Source: Yan, Mao and Li, "SECOND: Sparsely Embedded Convolutional Detection", Sensors 18(10), 2018:

    x, y    offset / diagonal of the anchor      z    offset / height of the anchor
    l, w, h    ln(size / size of the anchor)     yaw    difference

Example: the anchor (10, 0, -1, 3.9, 1.6, 1.56, 0) and the box (11, 0, -1, 3.9, 1.6, 1.56, 0.1) give
the code (1 / sqrt(3.9^2 + 1.6^2) = 0.237, 0, 0, 0, 0, 0, 0.1).
"""

import math
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from curate.detectors.openpcdet.schema import ModelFile
from curate.shapes import Float32

CODE = 7
"""Numbers of a box code."""
# Sizes below this are raised to it before a division or a logarithm.
_LEAST_SIZE = 1e-5
# A box is at most 55 times as large as its anchor, and at least 1/55. Only a network that has
# hardly been trained goes beyond; its boxes would be infinite.
MOST_LOG = 4.0


def make_anchors(file: ModelFile) -> Float32[np.ndarray, "n 7"]:
    """Return all anchors of a model: boxes in the LiDAR frame, by y, x, class, size and rotation.

    Unless a class aligns them with the centres of cells, the outermost anchors are exactly at the
    ends of the range, so the steps are a little longer than the cells.
    """
    return np.concatenate(
        [part.reshape(*part.shape[:2], -1, CODE) for part in _anchors_by_class(file)], axis=2
    ).reshape(-1, CODE)


def anchor_classes(file: ModelFile) -> np.ndarray:
    """Return (n,) the number, from 0, of the class in CLASS_NAMES that each anchor is for."""
    classes = [
        np.full(part[0, 0].size // CODE, file.class_names.index(anchors.class_name))
        for part, anchors in zip(
            _anchors_by_class(file),
            file.model.dense_head.anchor_generator_config,
            strict=True,
        )
    ]
    cells = len(make_anchors(file)) // sum(map(len, classes))
    return np.tile(np.concatenate(classes), cells)


def _anchors_by_class(file: ModelFile) -> list[np.ndarray]:
    """Return (y cells, x cells, heights, sizes, rotations, 7) float32 anchors of each class."""
    low_x, low_y, _, high_x, high_y, _ = file.data_config.point_cloud_range
    parts = []
    for each in file.model.dense_head.anchor_generator_config:
        cells_x, cells_y = (count // each.feature_map_stride for count in file.data_config.grid[:2])
        along_x = _places(low_x, high_x, cells_x, aligned=each.align_center)
        along_y = _places(low_y, high_y, cells_y, aligned=each.align_center)
        heights = np.array(each.anchor_bottom_heights, dtype=np.float32)
        sizes = np.array(each.anchor_sizes, dtype=np.float32)
        rotations = np.array(each.anchor_rotations, dtype=np.float32)
        shape = (cells_y, cells_x, len(heights), len(sizes), len(rotations))
        boxes = np.empty((*shape, CODE), dtype=np.float32)
        boxes[..., 0] = along_x[None, :, None, None, None]
        boxes[..., 1] = along_y[:, None, None, None, None]
        boxes[..., 3:6] = sizes[:, None]
        boxes[..., 2] = heights[:, None, None] + boxes[..., 5] / 2
        boxes[..., 6] = rotations
        parts.append(boxes)
    return parts


def _places(low: float, high: float, cells: int, *, aligned: bool) -> np.ndarray:
    """Return (cells,) float32 coordinates of the anchors along an axis."""
    if aligned:
        step = (high - low) / cells
        return (low + step / 2 + step * np.arange(cells)).astype(np.float32)
    step = (high - low) / max(cells - 1, 1)
    return (low + step * np.arange(cells)).astype(np.float32)


def encode(boxes: Tensor, anchors: Tensor) -> Tensor:
    """Return the (n, 7) codes of (n, 7) boxes relative to (n, 7) anchors."""
    sizes = boxes[..., 3:6].clamp(min=_LEAST_SIZE)
    own = anchors[..., 3:6].clamp(min=_LEAST_SIZE)
    diagonal = torch.sqrt(own[..., :1] ** 2 + own[..., 1:2] ** 2)
    offset = boxes[..., :3] - anchors[..., :3]
    scale = torch.cat([diagonal, diagonal, own[..., 2:]], dim=-1)
    turned = boxes[..., 6:] - anchors[..., 6:]
    return torch.cat([offset / scale, torch.log(sizes / own), turned], dim=-1)


def decode(codes: Tensor, anchors: Tensor) -> Tensor:
    """Return the (..., 7) boxes of (..., 7) codes relative to (..., 7) anchors."""
    own = anchors[..., 3:6]
    diagonal = torch.sqrt(own[..., :1] ** 2 + own[..., 1:2] ** 2)
    scale = torch.cat([diagonal, diagonal, own[..., 2:]], dim=-1)
    centres = codes[..., :3] * scale + anchors[..., :3]
    sizes = torch.exp(codes[..., 3:6].clamp(-MOST_LOG, MOST_LOG)) * own
    return torch.cat([centres, sizes, codes[..., 6:] + anchors[..., 6:]], dim=-1)


def wrap(angles: Tensor, start: float, period: float = 2 * math.pi) -> Tensor:
    """Return angles shifted by whole periods into [-start * period, (1 - start) * period)."""
    return angles - torch.floor(angles / period + start) * period


def turned(
    vectors: Tensor, angles: Tensor, direction: Literal["forward", "back"] = "forward"
) -> Tensor:
    """Return (n, p, 3) vectors turned about z by (n,) angles, counter-clockwise if forward."""
    cos, sin = torch.cos(angles)[:, None], torch.sin(angles)[:, None]
    if direction == "back":
        sin = -sin
    x, y, z = vectors.unbind(dim=-1)
    return torch.stack([x * cos - y * sin, x * sin + y * cos, z], dim=-1)
