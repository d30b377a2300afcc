"""Masks in COCO's formats against slow encoders, shapely, and a published example."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import run_lengths

from curate.errors import DataError
from curate.segmenters.masks import decode_mask, decompress, fill_polygon, runs_to_mask

# From the page on COCO exports of Hasty's documentation, with its `area` and `bbox`.
PUBLISHED = (
    "WRQR14oT20K?D5M0O7I6K3M005K3M004L0N4N001O02N001N2O0001O2N00001O02N0000N3O0000002N00001O000O1O"
    "1000000000001O00000N20000000O01000000000000N2000O10O1000N20O10000N200000O01000000N11000000000"
    "000N20000000000O3N00001O2N001O0N3O002M2O002M3L7J101H>A_SbS3"
)


def test_a_published_mask_has_its_published_area_and_box() -> None:
    """2,211 x 2,097 pixels, with 6,718 in a box of 117 x 75."""
    mask = decode_mask({"size": [2211, 2097], "counts": PUBLISHED}, (2097, 2211))
    rows, columns = np.nonzero(mask)
    assert len(rows) == 6718
    box = columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1
    assert box == (504, 842, 117, 75)


@given(st.data())
def test_masks_are_decoded_from_both_forms_of_run_lengths(data) -> None:
    """A mask that begins inside has a first run of 0."""
    height, width = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 9))
    pixels = data.draw(st.lists(st.booleans(), min_size=height * width, max_size=height * width))
    mask = np.array(pixels).reshape(height, width)
    runs = run_lengths.runs(mask.tolist())
    np.testing.assert_array_equal(runs_to_mask(runs, (width, height)), mask)
    text = run_lengths.compress(runs)
    assert decompress(text) == runs
    found = decode_mask({"size": [height, width], "counts": text}, (width, height))
    np.testing.assert_array_equal(found, mask)


@given(st.lists(st.integers(0, 2**31), max_size=8))
def test_run_lengths_of_any_size_survive_compression(runs) -> None:
    """Large numbers, and falling ones with negative differences."""
    assert decompress(run_lengths.compress(runs)) == runs


@given(st.lists(st.integers(-8, 56), min_size=6, max_size=14).filter(lambda p: len(p) % 2 == 0))
@settings(max_examples=60)
def test_polygons_contain_the_pixels_with_centres_inside(eighths) -> None:
    """Self-intersecting and overhanging polygons too; no corner is at the height of a centre."""
    polygon = [value / 4 + 0.125 for value in eighths]
    mask = fill_polygon(polygon, (12, 10))
    expected = [
        [run_lengths.centre_inside(polygon, column, row) for column in range(12)]
        for row in range(10)
    ]
    np.testing.assert_array_equal(mask, expected)


def test_a_polygon_agrees_with_shapely() -> None:
    """A rotated rectangle and a star-like outline, at every pixel centre."""
    angles = np.linspace(0, 2 * np.pi, 21)[:-1]
    radii = np.where(np.arange(20) % 2, 11.3, 4.7)
    corners = np.column_stack([20.2 + radii * np.cos(angles), 15.1 + radii * np.sin(angles)])
    mask = fill_polygon(corners.ravel().tolist(), (40, 30))
    columns, rows = np.meshgrid(np.arange(40) + 0.5, np.arange(30) + 0.5)
    inside = shapely.contains_xy(shapely.Polygon(corners), columns.ravel(), rows.ravel())
    np.testing.assert_array_equal(mask, inside.reshape(30, 40))


def test_adjacent_polygons_share_no_pixel() -> None:
    """Two halves with an edge through pixel centres cover the image exactly once."""
    left, right = [0, 0, 4.5, 0, 4.5, 6, 0, 6], [4.5, 0, 9, 0, 9, 6, 4.5, 6]
    halves = [fill_polygon(half, (9, 6)) for half in (left, right)]
    assert (halves[0] ^ halves[1]).all()
    assert decode_mask([left, right], (9, 6)).all()
    assert not decode_mask([], (9, 6)).any()


@pytest.mark.parametrize(
    ("segmentation", "message"),
    [
        ({"size": [6, 8], "counts": [48]}, "the mask is 8 x 6 pixels, the image is 9 x 6"),
        ({"counts": [54]}, "the mask has no valid size"),
        ({"size": [10**400, 8], "counts": [48]}, "the mask has no valid size"),
        (
            {"size": [6, 9], "counts": [50]},
            "the run lengths add up to 50; an image of 9 x 6 has 54 pixels",
        ),
        ({"size": [6, 9], "counts": [60, -6]}, "the run lengths are not valid integers"),
        ({"size": [6, 9], "counts": None}, "the run lengths are not valid integers"),
        ({"size": [6, 9], "counts": "é"}, "not a character of compressed run lengths"),
        ({"size": [6, 9], "counts": "f"}, "the compressed run lengths are truncated"),
        ([[0, 0, 1, 1]], "at least three corners"),
        ([["a"] * 6], "at least three corners"),
        ([[0, 0, 1, 1, float("nan"), 2]], "at least three corners"),
        ("mask", "run lengths {size, counts} or a list of polygons"),
    ],
)
def test_an_invalid_mask_gives_a_one_line_error(segmentation, message) -> None:
    """With what was expected."""
    with pytest.raises(DataError) as caught:
        decode_mask(segmentation, (9, 6))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
