"""Curves over a share: where they are drawn, and what is left out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from curate.viewing.curves import Curve, CurvePanel, draw_curves, spread_apart, value_range

SHARES = np.array([0.04, 0.08, 0.16])


def curve(name: str, *means: float, std: float = 1.0) -> Curve:
    """A line with a band of even height."""
    return Curve(name, np.array(means), np.full(len(means), std))


def coloured_rows(picture: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """Rows that hold a pixel of a colour."""
    return np.flatnonzero((picture == np.array(colour)).all(axis=2).any(axis=1))


def test_a_better_method_is_drawn_higher() -> None:
    """The first curve's colour is grey, the second one's is red; 60 lies above 20."""
    panel = CurvePanel("AP", SHARES, [curve("worse", 20, 20, 20), curve("better", 60, 60, 60)])
    picture = draw_curves([panel], "title", "note")
    worse, better = (coloured_rows(picture, c) for c in ((139, 150, 165), (222, 120, 92)))
    assert len(worse)
    assert len(better)
    assert np.median(better) + 100 < np.median(worse)


@pytest.mark.parametrize("shares", [SHARES[:1], SHARES])
def test_missing_values_are_left_out(shares: np.ndarray) -> None:
    """A method without results, one without spread, one with a gap, a single share."""
    nothing = np.full(len(shares), np.nan)
    some = np.full(len(shares), 30.0)
    gap = some.copy()
    gap[0] = np.nan
    curves = [Curve("none", nothing, nothing), Curve("one", some, nothing), Curve("gap", gap, some)]
    picture = draw_curves([CurvePanel("AP", shares, curves)] * 2, "title", "note")
    assert picture.dtype == np.uint8
    assert len(coloured_rows(picture, (222, 120, 92)))


@given(
    st.lists(st.tuples(st.floats(0, 100), st.floats(0, 30)), min_size=1, max_size=5),
)
def test_the_axis_holds_every_band(values: list[tuple[float, float]]) -> None:
    """Its ends are whole steps; only what would be below 0 is outside."""
    means, stds = np.array(values).T
    low, high, step = value_range([Curve("any", means, stds)])
    assert low <= max((means - stds).min(), 0) + 1e-9
    assert high >= (means + stds).max() - 1e-9
    assert low / step == pytest.approx(round(low / step), abs=1e-6)
    assert 1 - 1e-6 <= (high - low) / step <= 12


@given(st.lists(st.floats(0, 200), max_size=10).map(sorted))
def test_names_are_kept_apart(places: list[float]) -> None:
    """In their order, none beyond the end."""
    moved = spread_apart(places, 16.0, 200.0)
    assert (np.diff(moved) >= 16 - 1e-6).all()
    assert all(place <= 200 for place in moved)


def test_names_that_are_far_apart_stay() -> None:
    """Nothing moves without need."""
    assert spread_apart([10.0, 50.0, 90.0], 16.0, 200.0) == [10.0, 50.0, 90.0]
