"""Compiled kernels of `encoding`: features of the points, and maps of the objects."""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def point_features(
    points: np.ndarray, bounds: np.ndarray, pillar_m: float, cells: tuple[int, int], width: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return (n, width) float32 features and (n,) slots of the points within the bounds.

    The kernel of `encode_points`.

    Args:
        points: (p, 4) float32.
        bounds: (3, 2) lowest and highest x, y and z in metres.
        pillar_m: edge of a pillar in metres.
        cells: number of output cells along x and along y.
        width: number of features.
    """
    cells_x, cells_y = cells
    # Points are compared and divided in their own type, and the features computed in float64.
    limits, edge = bounds.astype(np.float32), np.float32(pillar_m)
    kept = np.empty(len(points), np.int64)
    slots = np.empty(len(points), np.int64)
    sums = np.zeros((4 * cells_x * cells_y, 4))  # of the points of each slot: number, x, y, z
    number = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if not (
            limits[0, 0] <= x < limits[0, 1]
            and limits[1, 0] <= y < limits[1, 1]
            and limits[2, 0] <= z < limits[2, 1]
        ):
            continue
        # Rounding can move a point just below the upper edge onto the edge.
        column = min(int((x - limits[0, 0]) / edge), 2 * cells_x - 1)
        row = min(int((y - limits[1, 0]) / edge), 2 * cells_y - 1)
        slot = ((column // 2) * cells_y + row // 2) * 4 + (column % 2) * 2 + row % 2
        kept[number], slots[number] = i, slot
        number += 1
        sums[slot, 0] += 1
        sums[slot, 1] += x
        sums[slot, 2] += y
        sums[slot, 3] += z
    features = np.empty((number, width), np.float32)
    for j in range(number):
        x, y, z = points[kept[j], 0], points[kept[j], 1], points[kept[j], 2]
        slot = slots[j]
        column = 2 * (slot // 4 // cells_y) + slot % 4 // 2
        row = 2 * (slot // 4 % cells_y) + slot % 2
        count = sums[slot, 0]
        # Distances are in units of a pillar.
        features[j, 0] = z
        features[j, 1] = points[kept[j], 3]
        features[j, 2] = (x - (bounds[0, 0] + (column + 0.5) * pillar_m)) / pillar_m
        features[j, 3] = (y - (bounds[1, 0] + (row + 0.5) * pillar_m)) / pillar_m
        features[j, 4] = (x - sums[slot, 1] / count) / pillar_m
        features[j, 5] = (y - sums[slot, 2] / count) / pillar_m
        features[j, 6] = z - sums[slot, 3] / count
        features[j, 7] = math.log(count) / 3
        features[j, 8] = np.hypot(x, y) / limits[0, 1]
    return features, slots[:number].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def draw_objects(
    heatmap: np.ndarray,
    background: np.ndarray,
    cell: np.ndarray,
    category_ids: np.ndarray,
    weights: np.ndarray,
    shapes: np.ndarray,
    cutoff_sigmas: float,
) -> None:
    """Draw the objects' gaussians into the heatmap and their regions into the background map.

    Args:
        heatmap: (x cells, y cells, categories) float32; an object of weight 0 is not drawn.
        background: (x cells, y cells) float32.
        cell: (m, 2) int64 centre cell of each object.
        category_ids: (m,) int64.
        weights: (m,) float32.
        shapes: (m, 5) half length, half width, standard deviation along and across, in cells, and
            yaw.
        cutoff_sigmas: the gaussians end at this number of standard deviations.
    """
    for k in range(len(cell)):
        half_length, half_width, sigma_along, sigma_across, yaw = shapes[k]
        reach = math.ceil(cutoff_sigmas * max(sigma_along, sigma_across))
        cos, sin = math.cos(yaw), math.sin(yaw)
        for i in range(
            max(0, cell[k, 0] - reach), min(background.shape[0], cell[k, 0] + reach + 1)
        ):
            for j in range(
                max(0, cell[k, 1] - reach), min(background.shape[1], cell[k, 1] + reach + 1)
            ):
                away_x, away_y = i - cell[k, 0], j - cell[k, 1]
                along, across = cos * away_x + sin * away_y, cos * away_y - sin * away_x
                squared = (along / sigma_along) ** 2 + (across / sigma_across) ** 2
                in_gaussian = squared <= cutoff_sigmas**2
                if in_gaussian and weights[k] > 0:
                    value = np.float32(math.exp(-squared / 2))
                    heatmap[i, j, category_ids[k]] = max(heatmap[i, j, category_ids[k]], value)
                if in_gaussian or (abs(along) <= half_length and abs(across) <= half_width):
                    background[i, j] = min(background[i, j], weights[k])
