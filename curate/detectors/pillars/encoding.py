"""Between metres and the network: points to pillar features, boxes to targets, answers to boxes.

Center-based detection after Yin et al., "Center-based 3D Object Detection and Tracking", CVPR 2021,
on pillars after Lang et al., "PointPillars", CVPR 2019. Three things differ. The gaussian of the
heatmap is as long, wide and turned as the object, not round. The yaw has two codes, its doubled
angle and the angle itself: where front and back of an object look alike the second averages out to
nothing, the first still holds the axis. And heights are measured from the ground, on which all
objects stand: what is left to learn of an object's z is half its height.

Beside score and box each cell estimates the 3D IoU of its box with the object, after Hu et al.,
"AFDetV2", AAAI 2022; 3DIoUMatch (Wang et al., CVPR 2021) filters pseudo-labels by such an estimate.
"""

from dataclasses import dataclass

import numpy as np

from curate.detections import Detections, as_categories
from curate.detectors.pillars.presets import Preset
from curate.geometry.overlap import paired_iou_3d
from curate.geometry.similarity import wrap_angle

POINT_FEATURES = 9
# Offset in cells along x and y from the cell's centre, z, logarithms of length, width and height,
# sine and cosine of twice the yaw, sine and cosine of the yaw.
BOX_CODE = 10

# Spread of an object's gaussian: a sixth of its side, but never so narrow that its neighbour cells
# do not feel it. Beyond three spreads it has ended.
_SPREAD_PER_SIDE = 1 / 6
_NARROWEST_SPREAD_CELLS = 0.7
_SPREADS = 3.0
# Cells around the centre that also learn the object's box.
_NEIGHBOURS = 1
_CANDIDATES = 500


@dataclass(frozen=True)
class Pillars:
    """The points of one frame as the network takes them.

    Attributes:
        features: (n, POINT_FEATURES) float32.
        slots: (n,) int64 row of each point's pillar in the canvas. The four pillars of an output
            cell are adjacent rows, so that the canvas reads as one row of four pillars per cell.
    """

    features: np.ndarray
    slots: np.ndarray


@dataclass(frozen=True)
class Targets:
    """What the network shall answer for one frame with m objects, each with a weight v.

    Attributes:
        heatmap: (x cells, y cells, categories) float32, 1 at the objects' centres.
        background: (x cells, y cells) float32, how surely what is not object is background: v
            in an object's region, the lowest v where regions overlap, 1 elsewhere.
        centres: (m,) int64 flat cell of each object's centre.
        categories: (m,) int64.
        weights: (m,) float32 v.
        code_cells: (r,) int64 flat cells that learn a box, several per object.
        codes: (r, BOX_CODE) float32.
        code_weights: (r,) float32, v shared out among the cells of an object.
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
    x, y, z, intensity = (points[:, axis] for axis in range(4))
    inside = (
        _within(x, preset.x_range) & _within(y, preset.y_range) & _within(z, preset.height_range)
    )
    x, y, z, intensity = x[inside], y[inside], z[inside], intensity[inside]
    column = ((x - preset.x_range[0]) / preset.pillar_m).astype(np.int64)
    row = ((y - preset.y_range[0]) / preset.pillar_m).astype(np.int64)
    # Rounding can push a point that lies just below the upper edge onto it.
    cells_x, cells_y = preset.cells
    np.minimum(column, 2 * cells_x - 1, out=column)
    np.minimum(row, 2 * cells_y - 1, out=row)
    slots = ((column // 2) * cells_y + row // 2) * 4 + (column % 2) * 2 + row % 2

    slot_count = 4 * cells_x * cells_y
    count = np.maximum(np.bincount(slots, minlength=slot_count), 1)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray((np.bincount(slots, values, slot_count) / count)[slots])

    from_centre_x = x - (preset.x_range[0] + (column + 0.5) * preset.pillar_m)
    from_centre_y = y - (preset.y_range[0] + (row + 0.5) * preset.pillar_m)
    features = np.stack(
        [
            z,
            intensity,
            from_centre_x / preset.pillar_m,
            from_centre_y / preset.pillar_m,
            (x - mean(x)) / preset.pillar_m,
            (y - mean(y)) / preset.pillar_m,
            z - mean(z),
            np.log(count[slots]) / 3,
            np.hypot(x, y) / preset.x_range[1],
        ],
        axis=1,
    )
    return Pillars(features.astype(np.float32), slots)


def encode_boxes(
    boxes: np.ndarray, category_ids: np.ndarray, weights: np.ndarray, count: int, preset: Preset
) -> Targets:
    """Return the targets of one frame.

    Args:
        boxes: (n, 7) in the LiDAR frame but z measured from the ground, sides positive; boxes
            with a centre off the grid are left out.
        category_ids: (n,) integers in [0, count).
        weights: (n,) v in [0, 1]; 0 marks an ignore region.
        count: number of categories.
        preset: the grid.
    """
    position = (boxes[:, :2] - [preset.x_range[0], preset.y_range[0]]) / preset.cell_m
    cell = np.floor(position).astype(np.int64)
    on_grid = ((cell >= 0) & (cell < preset.cells)).all(axis=1)
    boxes, position, cell = boxes[on_grid], position[on_grid], cell[on_grid]
    category_ids = np.asarray(category_ids)[on_grid].astype(np.int64)
    weights = np.asarray(weights)[on_grid].astype(np.float32)
    heatmap = np.zeros((*preset.cells, count), dtype=np.float32)
    background = np.ones(preset.cells, dtype=np.float32)
    _draw(heatmap, background, boxes, cell, category_ids, weights, preset.cell_m)
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
    """Return the boxes in the network's answers, before non-maximum suppression, z from the ground.

    Args:
        scores: (x cells, y cells, categories) in [0, 1]. All cells that reach the threshold answer,
            not only local maxima: two pedestrians can stand in adjacent cells, and cells that see
            the same object answer the same box, of which suppression leaves one.
        codes: (x cells, y cells, BOX_CODE).
        ious: (x cells, y cells) estimated 3D IoU of each cell's box with the object.
        categories: their names.
        preset: the grid.
        minimum_score: lower scores are left out.
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
    """Return (n, 7) boxes of (n, BOX_CODE) codes at (n,) flat cells."""
    column, row = np.divmod(cells, preset.cells[1])
    axis = np.arctan2(codes[:, 6], codes[:, 7]) / 2
    forward = codes[:, 8] * np.sin(axis) + codes[:, 9] * np.cos(axis)
    yaw = wrap_angle(np.where(forward >= 0, axis, axis + np.pi))
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
    answered: np.ndarray, codes: np.ndarray, cells: np.ndarray, preset: Preset
) -> np.ndarray:
    """(n,) 3D IoU of the boxes of (n, BOX_CODE) answers with those of the codes at their cells."""
    boxes, objects = (
        decode_boxes(of.astype(np.float64), cells, preset) for of in (answered, codes)
    )
    return paired_iou_3d(boxes, objects)


def _within(values: np.ndarray, bounds: tuple[float, float]) -> np.ndarray:
    return (values >= bounds[0]) & (values < bounds[1])


def _draw(
    heatmap: np.ndarray,
    background: np.ndarray,
    boxes: np.ndarray,
    cell: np.ndarray,
    category_ids: np.ndarray,
    weights: np.ndarray,
    cell_m: float,
) -> None:
    """Enter the objects' gaussians and regions into the two maps."""
    sides = boxes[:, 3:5] / cell_m
    spreads = np.maximum(sides * _SPREAD_PER_SIDE, _NARROWEST_SPREAD_CELLS)
    for k in range(len(boxes)):
        reach = int(np.ceil(_SPREADS * spreads[k].max()))
        window = tuple(
            slice(
                max(0, cell[k, axis] - reach),
                min(background.shape[axis], cell[k, axis] + reach + 1),
            )
            for axis in (0, 1)
        )
        away_x = (np.arange(window[0].start, window[0].stop) - cell[k, 0])[:, None]
        away_y = (np.arange(window[1].start, window[1].stop) - cell[k, 1])[None, :]
        cos, sin = np.cos(boxes[k, 6]), np.sin(boxes[k, 6])
        along, across = cos * away_x + sin * away_y, cos * away_y - sin * away_x
        distance = (along / spreads[k, 0]) ** 2 + (across / spreads[k, 1]) ** 2
        in_box = (2 * np.abs(along) <= sides[k, 0]) & (2 * np.abs(across) <= sides[k, 1])
        region = in_box | (distance <= _SPREADS**2)
        plane = heatmap[(*window, category_ids[k])]
        if weights[k] > 0:
            gaussian = np.where(distance <= _SPREADS**2, np.exp(-distance / 2), 0)
            np.maximum(plane, gaussian, out=plane, casting="same_kind")
        surroundings = background[window]
        np.minimum(surroundings, weights[k], out=surroundings, where=region)


def _box_codes(
    boxes: np.ndarray, position: np.ndarray, cell: np.ndarray, preset: Preset
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Row of the object, flat cell, code and share of every cell that learns a box."""
    steps = np.arange(-_NEIGHBOURS, _NEIGHBOURS + 1)
    around = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(1, -1, 2)
    cells = cell[:, None] + around
    away = position[:, None] - (cells + 0.5)
    # A neighbour counts by how near the object's centre is to it, the centre's own cell fully.
    share = np.where((around == 0).all(axis=-1), 1.0, np.exp(-2 * (away**2).sum(axis=-1)))
    share *= ((cells >= 0) & (cells < preset.cells)).all(axis=-1)
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-9)
    rows, which = np.nonzero(share > 0)
    yaw = boxes[rows, 6]
    codes = np.column_stack(
        [
            away[rows, which],
            boxes[rows, 2],
            np.log(boxes[rows, 3:6]),
            np.sin(2 * yaw),
            np.cos(2 * yaw),
            np.sin(yaw),
            np.cos(yaw),
        ]
    )
    chosen = cells[rows, which]
    return rows, chosen[:, 0] * preset.cells[1] + chosen[:, 1], codes, share[rows, which]
