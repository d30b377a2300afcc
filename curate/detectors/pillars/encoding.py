"""Encoding of points as pillar features and of boxes as targets; decoding of outputs to boxes.

Center-based detection after Yin et al., "Center-based 3D Object Detection and Tracking", CVPR 2021,
on pillars after Lang et al., "PointPillars", CVPR 2019. Three differences:

- The gaussian of the heatmap has the length, width and yaw of the object; it is not round.
- The yaw has two codes, of the doubled angle and of the angle. If front and back of an object look
  alike, the code of the angle averages to zero, but that of the doubled angle still gives the axis.
- Heights are measured from the ground. All objects stand on it, so z is half the object's height.

Each cell also estimates the 3D IoU of its box with the object, after Hu et al., "AFDetV2",
AAAI 2022. 3DIoUMatch (Wang et al., CVPR 2021) filters pseudo-labels by such an estimate.

Example: preset small (x from 0, y from -32 m, cells of 0.64 m, 80 x 100 of them), a car at
x = 20.0, y = -3.0, z = 0.75 above the ground, 3.9 x 1.6 x 1.5 m, yaw 0.5

    position in cells     (20.0 - 0) / 0.64 = 31.25,  (-3.0 + 32) / 0.64 = 45.3125
    centre cell           (31, 45), flat index 31 * 100 + 45 = 3145
    code 0, 1   offset    31.25 - 31.5 = -0.25,  45.3125 - 45.5 = -0.1875   (from the cell's centre)
    code 2-5    z, sizes  0.75, ln 3.9 = 1.361, ln 1.6 = 0.470, ln 1.5 = 0.405
    code 6, 7   axis      sin 1.0 = 0.841, cos 1.0 = 0.540
    code 8, 9   heading   sin 0.5 = 0.479, cos 0.5 = 0.878

    decoded               x = (31.5 - 0.25) * 0.64 = 20.0,  y = -32 + (45.5 - 0.1875) * 0.64 = -3.0
                          axis = atan2(0.841, 0.540) / 2 = 0.5; the heading (0.878, 0.479) points
                          along the axis, not against it, so yaw = 0.5 and not 0.5 - pi

The eight cells around the centre cell learn the same box, with their own offset: cell (32, 45) has
code 0 = -1.25. The weight v of the car is shared: 57 % for the centre cell, 17 % for its nearest
neighbour (30, 45), less for the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curate.detections import Detections, as_categories
from curate.detectors.pillars.presets import Preset
from curate.geometry.overlap import paired_iou_3d
from curate.geometry.similarity import wrap_angle

POINT_FEATURES = 9
# Numbers of a box code: offset in cells along x and y from the cell's centre, z, logarithms of
# length, width and height, sine and cosine of twice the yaw, sine and cosine of the yaw.
BOX_CODE = 10

# Standard deviation of an object's gaussian: a sixth of its side, but at least so large that the
# neighbouring cells get part of it. The gaussian is cut off at three standard deviations.
_SIGMA_PER_SIDE = 1 / 6
_MIN_SIGMA_CELLS = 0.7
_CUTOFF_SIGMAS = 3.0
# Cells on each side of the centre cell that also learn the object's box.
_NEIGHBOURS = 1
# Highest number of boxes per frame before non-maximum suppression.
_CANDIDATES = 500


@dataclass(frozen=True)
class Pillars:
    """The points of one frame as the input of the network.

    Attributes:
        features: (n, POINT_FEATURES) float32.
        slots: (n,) int64 row of each point's pillar in the canvas. The four pillars of an output
            cell are adjacent rows: the canvas can be viewed as one row of four pillars per cell.
    """

    features: np.ndarray
    slots: np.ndarray


def joined(frames: Sequence[Pillars], preset: Preset) -> tuple[np.ndarray, np.ndarray]:
    """Return features and slots of several frames as one input of the network."""
    slots_per_frame = 4 * preset.cells[0] * preset.cells[1]
    slots = [frame.slots + i * slots_per_frame for i, frame in enumerate(frames)]
    return np.concatenate([frame.features for frame in frames]), np.concatenate(slots)


@dataclass(frozen=True)
class Targets:
    """Targets of the network for one frame with m objects, each with a weight v.

    Attributes:
        heatmap: (x cells, y cells, categories) float32, 1 at the centres of objects with v > 0.
        background: (x cells, y cells) float32 weight of a cell as a negative example: v in an
            object's region, the lowest v if regions overlap, 1 outside all regions.
        centres: (m,) int64 flat cell index of each object's centre.
        categories: (m,) int64 category number of each object.
        weights: (m,) float32 weight v of each object.
        code_cells: (r,) int64 flat indices of the cells that learn a box, several per object.
        codes: (r, BOX_CODE) float32 code of the object's box in each of these cells.
        code_weights: (r,) float32 weight of each code; the weights of an object sum to its v.
    """

    heatmap: np.ndarray
    background: np.ndarray
    centres: np.ndarray
    categories: np.ndarray
    weights: np.ndarray
    code_cells: np.ndarray
    codes: np.ndarray
    code_weights: np.ndarray


def encode_points(points: np.ndarray, preset: Preset) -> Pillars:
    """Return the pillar features of (n, 4) points; points off the grid are left out.

    Args:
        points: in the LiDAR frame, but z measured from the ground (see `GroundMap.lowered`).
        preset: the grid.
    """
    from curate.detectors.pillars.encoding_kernels import point_features

    bounds = np.array([preset.x_range, preset.y_range, preset.height_range])
    rows = np.ascontiguousarray(points[:, :4], dtype=np.float32)
    return Pillars(*point_features(rows, bounds, preset.pillar_m, preset.cells, POINT_FEATURES))


def encode_boxes(
    boxes: np.ndarray, category_ids: np.ndarray, weights: np.ndarray, count: int, preset: Preset
) -> Targets:
    """Return the targets of one frame; see the example at the head of this module.

    Args:
        boxes: (n, 7) in the LiDAR frame, but z measured from the ground; sides are positive. Boxes
            with a centre off the grid are left out.
        category_ids: (n,) integers in [0, count).
        weights: (n,) v in [0, 1]; 0 marks an ignore region.
        count: number of categories.
        preset: the grid.
    """
    from curate.detectors.pillars.encoding_kernels import draw_objects

    position = (boxes[:, :2] - [preset.x_range[0], preset.y_range[0]]) / preset.cell_m
    cell = np.floor(position).astype(np.int64)
    on_grid = ((cell >= 0) & (cell < preset.cells)).all(axis=1)
    boxes, position, cell = boxes[on_grid], position[on_grid], cell[on_grid]
    category_ids = np.asarray(category_ids)[on_grid].astype(np.int64)
    weights = np.asarray(weights)[on_grid].astype(np.float32)
    heatmap = np.zeros((*preset.cells, count), dtype=np.float32)
    background = np.ones(preset.cells, dtype=np.float32)
    sides = boxes[:, 3:5] / preset.cell_m
    sigmas = np.maximum(sides * _SIGMA_PER_SIDE, _MIN_SIGMA_CELLS)
    shapes = np.column_stack([sides / 2, sigmas, boxes[:, 6]])
    draw_objects(heatmap, background, cell, category_ids, weights, shapes, _CUTOFF_SIGMAS)
    rows, code_cells, codes, shares = _box_codes(boxes, position, cell, preset)
    return Targets(
        heatmap,
        background,
        cell[:, 0] * preset.cells[1] + cell[:, 1],
        category_ids,
        weights,
        code_cells,
        codes.astype(np.float32),
        (weights[rows] * shares).astype(np.float32),
    )


def decode(
    scores: np.ndarray,
    codes: np.ndarray,
    ious: np.ndarray,
    categories: tuple[str, ...],
    preset: Preset,
    minimum_score: float,
) -> Detections:
    """Return the predicted boxes before non-maximum suppression, with z measured from the ground.

    Args:
        scores: (x cells, y cells, categories) in [0, 1]. Every cell that reaches the minimum score
            gives a box, not only local maxima: two pedestrians can stand in adjacent cells. Cells
            that see the same object give nearly the same box; suppression keeps one of them.
        codes: (x cells, y cells, BOX_CODE).
        ious: (x cells, y cells) estimated 3D IoU of each cell's box with the object.
        categories: names of the categories.
        preset: the grid.
        minimum_score: boxes with a lower score are left out.
    """
    flat = scores.reshape(-1)
    candidates = np.flatnonzero(flat >= max(minimum_score, np.finfo(np.float32).tiny))
    best = np.argsort(-flat[candidates], kind="stable")[:_CANDIDATES]
    candidates = candidates[best]
    cells, category_ids = np.divmod(candidates, len(categories))
    chosen = codes.reshape(-1, BOX_CODE)[cells].astype(np.float64)
    return Detections(
        decode_boxes(chosen, cells, preset),
        flat[candidates].astype(np.float64),
        as_categories(np.asarray(categories)[category_ids]),
        ious.reshape(-1)[cells].astype(np.float64),
    )


def decode_boxes(codes: np.ndarray, cells: np.ndarray, preset: Preset) -> np.ndarray:
    """Return (n, 7) boxes, decoded from (n, BOX_CODE) codes at (n,) flat cell indices."""
    column, row = np.divmod(cells, preset.cells[1])
    axis = np.arctan2(codes[:, 6], codes[:, 7]) / 2
    # Cosine of the angle between heading and axis: its sign selects one of the two directions.
    along_axis = codes[:, 8] * np.sin(axis) + codes[:, 9] * np.cos(axis)
    yaw = wrap_angle(np.where(along_axis >= 0, axis, axis + np.pi))
    return np.column_stack(
        [
            preset.x_range[0] + (column + 0.5 + codes[:, 0]) * preset.cell_m,
            preset.y_range[0] + (row + 0.5 + codes[:, 1]) * preset.cell_m,
            codes[:, 2],
            np.exp(np.clip(codes[:, 3:6], -5, 5)),
            yaw,
        ]
    )


def code_ious(
    predicted: np.ndarray, target: np.ndarray, cells: np.ndarray, preset: Preset
) -> np.ndarray:
    """Return (n,) 3D IoU between the boxes of predicted and of target codes, row by row.

    Args:
        predicted: (n, BOX_CODE).
        target: (n, BOX_CODE).
        cells: (n,) flat cell index of both codes.
        preset: the grid.
    """
    boxes, objects = (
        decode_boxes(codes.astype(np.float64), cells, preset) for codes in (predicted, target)
    )
    return paired_iou_3d(boxes, objects)


def _box_codes(
    boxes: np.ndarray, position: np.ndarray, cell: np.ndarray, preset: Preset
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the codes of all cells that learn a box.

    Returns:
        Of each code: (r,) index of the object, (r,) flat cell index, (r, BOX_CODE) code, and (r,)
        share of the object's weight.
    """
    steps = np.arange(-_NEIGHBOURS, _NEIGHBOURS + 1)
    around = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(1, -1, 2)
    cells = cell[:, None] + around
    offset = position[:, None] - (cells + 0.5)
    # The share of a neighbour falls with its distance to the object's centre.
    share = np.where((around == 0).all(axis=-1), 1.0, np.exp(-2 * (offset**2).sum(axis=-1)))
    share *= ((cells >= 0) & (cells < preset.cells)).all(axis=-1)
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-9)
    rows, neighbour = np.nonzero(share > 0)
    yaw = boxes[rows, 6]
    codes = np.column_stack(
        [
            offset[rows, neighbour],
            boxes[rows, 2],
            np.log(boxes[rows, 3:6]),
            np.sin(2 * yaw),
            np.cos(2 * yaw),
            np.sin(yaw),
            np.cos(yaw),
        ]
    )
    chosen = cells[rows, neighbour]
    return rows, chosen[:, 0] * preset.cells[1] + chosen[:, 1], codes, share[rows, neighbour]
