"""Points to pillars, boxes to targets, and outputs back to boxes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from curate.detectors.pillars.encoding import (
    BOX_CODE,
    decode,
    decode_boxes,
    encode_boxes,
    encode_points,
)
from curate.detectors.pillars.presets import PRESETS, preset_named
from curate.errors import ConfigError

SMALL = PRESETS["small"]
NAMES = ("Car", "Pedestrian", "Cyclist")


def car(x, y, yaw=0.0, length=4.0, width=1.6):
    """Return one box as (1, 7)."""
    return np.array([[x, y, -0.8, length, width, 1.5, yaw]])


def targets_of(boxes, weights=None, ids=None):
    """Return targets in the small grid, by default of cars with weight 1."""
    weights = np.ones(len(boxes)) if weights is None else np.asarray(weights)
    ids = np.zeros(len(boxes), dtype=int) if ids is None else np.asarray(ids)
    return encode_boxes(boxes, ids, weights, len(NAMES), SMALL)


def cell_of(x, y):
    """Return the small grid's cell at a position."""
    return int(x / SMALL.cell_m), int((y + 32) / SMALL.cell_m)


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_grids_can_be_halved_twice(preset):
    """Each preset's cells cover its ranges exactly and divide by four."""
    for cells, bounds in zip(preset.cells, (preset.x_range, preset.y_range), strict=True):
        assert cells % 4 == 0
        assert cells * preset.cell_m == pytest.approx(bounds[1] - bounds[0])


def test_the_error_for_an_unknown_preset_lists_the_known_ones():
    with pytest.raises(ConfigError, match=r"tiny.*small, kitti"):
        preset_named("tiny")


def test_points_off_the_grid_are_left_out():
    """Behind, beside, above and beyond the grid nothing is encoded."""
    points = np.array(
        [[-1, 0, 0, 0], [51.2, 0, 0, 0], [5, 32, 0, 0], [5, -33, 0, 0], [5, 0, 9, 0], [5, 0, 0, 1]],
        dtype=np.float32,
    )
    pillars = encode_points(points, SMALL)
    assert pillars.features.shape == (1, 9)
    assert pillars.features.dtype == np.float32
    assert pillars.features[0, :2].tolist() == [0.0, 1.0]


def test_the_last_point_below_the_edge_stays_on_the_grid():
    """Rounding does not move a point below the upper edge into a cell that does not exist."""
    edge = np.nextafter(np.float32(SMALL.x_range[1]), np.float32(0))
    side = np.nextafter(np.float32(32), np.float32(0))
    pillars = encode_points(np.array([[edge, side, 0, 0]], dtype=np.float32), SMALL)
    assert pillars.slots.tolist() == [4 * 80 * 100 - 1]


def test_the_pillars_of_a_cell_are_adjacent_in_the_canvas():
    """The four pillars of output cell (1, 50) have the slots 4 * (1 * 100 + 50) and following."""
    corner = np.array([0.64, 0.0])
    offsets = np.array([[0.1, 0.1], [0.1, 0.4], [0.4, 0.1], [0.4, 0.4]])
    points = np.column_stack([corner + offsets, np.zeros((4, 2))]).astype(np.float32)
    assert encode_points(points, SMALL).slots.tolist() == [600, 601, 602, 603]


def test_features_are_relative_to_the_pillar():
    """Offsets from the pillar's centre and mean, count and distance, for a pillar of two points."""
    points = np.array([[3.2 + 0.1, 0.1, -1.0, 0.3], [3.2 + 0.3, 0.2, -0.5, 0.7]], dtype=np.float32)
    features = encode_points(points, SMALL).features
    assert features[0] == pytest.approx(
        [
            -1.0,
            0.3,
            (0.1 - 0.16) / 0.32,
            (0.1 - 0.16) / 0.32,
            -0.1 / 0.32,
            -0.05 / 0.32,
            -0.25,
            np.log(2) / 3,
            np.hypot(3.3, 0.1) / 51.2,
        ],
        abs=1e-5,
    )


def test_the_features_of_a_cloud_are_those_of_each_pillar_alone():
    """The pillars of many points do not influence each other."""
    generator = np.random.default_rng(0)
    low, high = [-5, -40, -2, 0], [60, 40, 5, 1]
    points = generator.uniform(low, high, (3000, 4)).astype(np.float32)
    points = np.concatenate([points, points[:500] + np.float32(0.02)])
    pillars = encode_points(points, SMALL)
    (inside,) = np.nonzero([len(encode_points(point[None], SMALL).slots) for point in points])
    assert len(inside) == len(pillars.slots)
    for slot in np.unique(pillars.slots):
        here = pillars.slots == slot
        alone = encode_points(points[inside[here]], SMALL)
        assert (alone.slots == slot).all()
        np.testing.assert_array_equal(alone.features, pillars.features[here])


def test_the_maps_are_those_of_the_formulas():
    """Gaussian and region of overlapping objects, in every cell of the grid."""
    generator = np.random.default_rng(0)
    count = 20
    boxes = np.column_stack(
        [
            generator.uniform(0, 20, count), generator.uniform(-10, 10, count), np.zeros(count),
            generator.uniform(0.4, 6, (count, 3)), generator.uniform(-4, 4, count),
        ]
    )  # fmt: skip
    ids, weights = generator.integers(0, 3, count), np.repeat([0.0, 0.5, 1.0, 0.7], count // 4)
    targets = targets_of(boxes, weights, ids)
    heatmap, background = np.zeros((*SMALL.cells, 3)), np.ones(SMALL.cells)
    x, y = np.meshgrid(*map(np.arange, SMALL.cells), indexing="ij")
    for box, category, weight in zip(boxes, ids, weights, strict=True):
        column, row = cell_of(*box[:2])
        cos, sin = np.cos(box[6]), np.sin(box[6])
        along = cos * (x - column) + sin * (y - row)
        across = cos * (y - row) - sin * (x - column)
        sigmas = np.maximum(box[3:5] / SMALL.cell_m / 6, 0.7)
        squared = (along / sigmas[0]) ** 2 + (across / sigmas[1]) ** 2
        gaussian = np.exp(-squared / 2) * (squared <= 9) * (weight > 0)
        heatmap[..., category] = np.maximum(heatmap[..., category], gaussian)
        region = (np.abs(along) <= box[3] / SMALL.cell_m / 2) & (
            np.abs(across) <= box[4] / SMALL.cell_m / 2
        )
        background[region | (squared <= 9)] = np.minimum(
            background[region | (squared <= 9)], weight
        )
    np.testing.assert_allclose(targets.heatmap, heatmap, rtol=1e-6)
    np.testing.assert_allclose(targets.background, background, rtol=1e-6)


def test_the_heatmap_is_one_at_the_centre_and_zero_far_away():
    """Only in the heatmap of the object's category."""
    targets = targets_of(car(20, 3))
    x, y = cell_of(20, 3)
    assert targets.heatmap[x, y, 0] == 1
    assert targets.heatmap[x + 12, y, 0] == 0
    assert np.count_nonzero(targets.heatmap == 1) == 1
    assert not targets.heatmap[..., 1:].any()
    assert targets.centres.tolist() == [x * 100 + y]


def test_the_gaussian_lies_along_the_object():
    """A long box across the view spreads along y, one along the view spreads along x."""
    x, y = cell_of(20, 3)
    across = targets_of(car(20, 3, np.pi / 2, length=8)).heatmap
    along = targets_of(car(20, 3, 0.0, length=8)).heatmap
    assert across[x, y + 2, 0] > across[x + 2, y, 0]
    assert along[x, y + 2, 0] == pytest.approx(across[x + 2, y, 0])


def test_weight_zero_draws_nothing_and_ignores_its_region():
    """An ignored box has no gaussian; its whole footprint is not background."""
    targets = targets_of(car(20, 3), weights=[0.0])
    x, y = cell_of(20, 3)
    assert not targets.heatmap.any()
    assert not targets.background[x - 3 : x + 4, y - 1 : y + 2].any()
    assert targets.background[x + 12, y] == 1
    assert targets.code_weights.sum() == 0


def test_background_has_the_lowest_weight_of_overlapping_objects():
    """Where the regions of two objects overlap, the lower weight counts."""
    targets = targets_of(np.concatenate([car(20, 3), car(20, 3.7)]), weights=[0.75, 0.25])
    x, y = cell_of(20, 3)
    assert targets.background[x, y] == 0.25
    assert targets.background[x, y - 2] == 0.75


def test_the_cells_of_an_object_share_its_weight():
    """The weights of all cells that learn a box sum to v."""
    targets = targets_of(np.concatenate([car(20, 3), car(40, -9.1)]), weights=[1.0, 0.5])
    half = targets.codes[:, 2:3].shape[0] // 2
    assert targets.code_weights[:half].sum() == pytest.approx(1.0)
    assert targets.code_weights[half:].sum() == pytest.approx(0.5)


def test_objects_off_the_grid_are_left_out():
    """A box with its centre outside the grid is not a target."""
    targets = targets_of(np.concatenate([car(-3, 0), car(70, 0), car(10, 40)]))
    assert len(targets.centres) == len(targets.codes) == 0
    assert not targets.heatmap.any()
    assert targets.background.all()


boxes_on_grid = st.tuples(
    st.floats(0.0, 51.19),
    st.floats(-31.99, 31.99),
    st.floats(-3, 2),
    st.floats(0.3, 12),
    st.floats(0.3, 4),
    st.floats(0.3, 4),
    st.floats(-np.pi, np.pi, exclude_min=True),
)


@settings(max_examples=60)
@given(boxes_on_grid)
def test_decoding_inverts_encoding(box):
    """Decoding the codes of an object gives the object back, from each of its cells."""
    expected = np.array([box])
    targets = targets_of(expected)
    decoded = decode_boxes(targets.codes.astype(np.float64), targets.code_cells, SMALL)
    assert len(decoded) >= 1
    assert np.allclose(decoded[:, :6], expected[:, :6], atol=1e-4)
    turned = np.abs(np.exp(1j * decoded[:, 6]) - np.exp(1j * expected[:, 6]))
    assert (turned < 1e-3).all()


def test_without_a_known_front_only_the_axis_is_kept():
    """If front and back are equally likely, the direction code is 0; the yaw holds modulo pi."""
    targets = targets_of(car(20, 3, yaw=2.0))
    codes = targets.codes[:1].astype(np.float64)
    codes[:, 8:] = 0
    decoded = decode_boxes(codes, targets.code_cells[:1], SMALL)
    assert np.sin(decoded[0, 6] - 2.0) == pytest.approx(0, abs=1e-6)


def test_decode_returns_peaks_above_the_threshold_best_first():
    """Scores, names and boxes of the peaks, in falling order."""
    scores = np.zeros((*SMALL.cells, 3), dtype=np.float32)
    codes = np.zeros((*SMALL.cells, BOX_CODE), dtype=np.float32)
    codes[..., 7] = codes[..., 9] = 1.0
    scores[10, 60, 2], scores[20, 50, 0], scores[30, 50, 1] = 0.5, 0.9, 0.09
    ious = np.full(SMALL.cells, 0.25, dtype=np.float32)
    ious[20, 50] = 0.75
    found = decode(scores, codes, ious, NAMES, SMALL, 0.1)
    assert found.iou.tolist() == [0.75, 0.25]
    assert found.categories.tolist() == ["Car", "Cyclist"]
    assert found.scores == pytest.approx([0.9, 0.5])
    assert found.boxes[0] == pytest.approx([20.5 * 0.64, 0.5 * 0.64, 0, 1, 1, 1, 0])


def test_decode_keeps_adjacent_cells():
    """Two people can stand in adjacent cells: neither is dropped."""
    scores = np.zeros((*SMALL.cells, 3), dtype=np.float32)
    codes = np.zeros((*SMALL.cells, BOX_CODE), dtype=np.float32)
    scores[20, 50, 1], scores[20, 51, 1] = 0.9, 0.8
    found = decode(scores, codes, scores[..., 0], NAMES, SMALL, 0.1)
    assert found.scores == pytest.approx([0.9, 0.8])


def test_decode_without_peaks_is_empty():
    """Even at threshold 0 the arrays are empty, with the right shapes."""
    zeros = np.zeros((*SMALL.cells, 3), dtype=np.float32)
    codes = np.zeros((*SMALL.cells, BOX_CODE), dtype=np.float32)
    found = decode(zeros, codes, zeros[..., 0], NAMES, SMALL, 0.0)
    assert found.boxes.shape == (0, 7)
    assert found.categories.shape == (0,)
