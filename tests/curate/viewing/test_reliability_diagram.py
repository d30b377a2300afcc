"""The reliability diagram: what is drawn where."""

import numpy as np
import pytest
from support.audited import many_labels, six_labels, small_audit

from curate.evaluation.audit import audit
from curate.evaluation.judged_labels import JudgedLabels
from curate.viewing.palette import PANEL, weight_colours
from curate.viewing.reliability_diagram import draw_reliability

# Of the first panel, as the module lays it out: the plot's left, right, top and bottom edge.
LEFT, RIGHT, TOP, BOTTOM = 60, 310, 130, 288


def bar_height(picture, b):
    """Pixels of the bar of bin b in the first panel that do not look like the empty panel."""
    middle = round(LEFT + (b + 0.3) / 10 * (RIGHT - LEFT))
    column = picture[TOP + 2 : BOTTOM - 2, middle].astype(int)
    colour = weight_colours(np.array([(b + 0.5) / 10]))[0].astype(int)
    blend = 0.9 * colour + 0.1 * np.array(PANEL)
    return int((np.abs(column - blend).max(axis=1) < 12).sum())


def test_bars_are_as_high_as_the_share_of_right_labels():
    """A judge whose weight is the chance to be right: bars along the diagonal."""
    labels, _ = many_labels(frames=200)
    generator = np.random.default_rng(0)
    weights = generator.random(len(labels))
    labels.right[:] = generator.random(len(labels)) < weights
    found = audit(labels, {"honest": weights}, (), generator, replicates=20)
    picture = draw_reliability(found, "title")
    heights = [bar_height(picture, b) / (BOTTOM - TOP) for b in range(10)]
    shares = found.whole()["honest"].bins.precision
    assert heights == pytest.approx(shares, abs=0.06)
    assert np.corrcoef(heights, np.arange(10))[0, 1] > 0.95


@pytest.mark.parametrize("policies", [1, 2, 3, 5, 7, 8])
def test_every_policy_has_its_panel(policies):
    """The picture grows with their number; four cells to a row, one of them for the AUROC."""
    labels, weights = many_labels()
    some = {f"policy {i}": weights["fair"] for i in range(policies)}
    picture = draw_reliability(
        audit(labels, some, (), np.random.default_rng(0), replicates=10), "title"
    )
    rows = -(-(policies + 1) // 4)
    assert picture.shape[0] == 36 + 40 + rows * 300 + (rows - 1) * 14 + 40
    assert picture.dtype == np.uint8


def test_undefined_figures_are_drawn_as_nothing():
    """All labels wrong, and no labels at all."""
    wrong = six_labels()
    wrong.right[:] = False
    for found in (
        small_audit(labels=wrong),
        small_audit({"all": np.zeros(0)}, JudgedLabels.no_frames()),
    ):
        assert draw_reliability(found, "title").ndim == 3
