"""Charts: positions of what is drawn, and contents of the files."""

import subprocess
import sys
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from support.audited import many_labels, six_labels, small_audit

from curate.errors import ConfigError
from curate.evaluation.audit import audit
from curate.evaluation.evaluated_labels import EvaluatedLabels
from curate.viewing.chart_style import check_format
from curate.viewing.charts import (
    Curve,
    CurvePanel,
    Mark,
    audit_chart,
    curves_chart,
    histogram,
    reliability,
)

SHARES = np.array([0.04, 0.08, 0.16])
BINS = (np.array([0.05, np.nan, 0.52, 0.93]), np.array([0.0, np.nan, 0.5, 0.9]),
        np.array([4, 0, 2000, 50_000]))  # fmt: skip


def drawn(axes, gid):
    """Return the artists with a name."""
    return axes.findobj(lambda artist: artist.get_gid() == gid)


def places(axes, gid="dot"):
    """Return (n, 2) positions of the dots, from left to right."""
    return np.array(sorted(tuple(dot.get_xydata()[0]) for dot in drawn(axes, gid)))


def texts(figure):
    """Return every text of a figure."""
    from matplotlib.text import Text

    return [found.get_text() for found in figure.findobj(Text) if found.get_visible()]


def curve(name, *means, std=1.0):
    """Return a line with error bars of constant length."""
    return Curve(name, np.array(means), np.full(len(means), std))


def test_bars_are_as_high_as_their_counts():
    """The axes are labelled; a mark outside the edges is left out."""
    marks = [Mark(1.0, "λ 1"), Mark(3.0, "λ 3")]
    figure = histogram("loss", np.array([4, 0, 2, 1]), np.linspace(0, 2, 5), "L", marks).figure
    [axes] = figure.axes
    assert [bar.get_height() for bar in axes.patches] == [4, 0, 2, 1]
    assert [bar.get_x() for bar in axes.patches] == [0, 0.5, 1, 1.5]
    assert [line.get_xdata()[0] for line in drawn(axes, "mark")] == [1]
    assert {"L", "labels", "λ 1"} <= set(texts(figure))
    assert "λ 3" not in texts(figure)


def test_a_histogram_without_data_is_flat():
    """And still a chart."""
    [axes] = histogram("v", np.zeros(3, int), np.linspace(0, 1, 4), "v").figure.axes
    assert [bar.get_height() for bar in axes.patches] == [0, 0, 0]
    assert axes.get_ylim() == (0, 1)


def test_bins_are_dots_with_intervals_and_counts():
    """No line connects the bins; few labels give a hollow dot and a long interval."""
    above, below = reliability("r", *BINS).figure.axes
    assert places(above) == pytest.approx(np.array([[0.05, 0], [0.52, 0.5], [0.93, 0.9]]))
    joined = [line for line in above.lines if len(line.get_xdata()) > 1]
    assert {line.get_gid() for line in joined} == {"diagonal", "interval"}
    low, middle, high = (line.get_ydata() for line in drawn(above, "interval"))
    assert low == pytest.approx([0, 0.49], abs=0.01)  # Wilson's interval of 0 of 4
    assert middle[0] < 0.5 < middle[1]
    assert np.ptp(low) > np.ptp(middle) > np.ptp(high)
    hollow = [dot.get_markerfacecolor() != dot.get_color() for dot in drawn(above, "dot")]
    assert hollow == [True, False, False]
    heights = [bar.get_height() for bar in below.patches]
    assert heights == pytest.approx(np.log10([5, 2001, 50_001]))
    assert {"4", "2000", "50k"} <= {found.get_text() for found in below.texts}


def test_calibrated_weights_lie_on_the_diagonal():
    """If the weight is the probability of a correct label."""
    labels, _ = many_labels(frames=200)
    generator = np.random.default_rng(0)
    weights = generator.random(len(labels))
    labels.correct[:] = generator.random(len(labels)) < weights
    found = audit(labels, {"honest": weights}, (), generator, replicates=20)
    x, y = places(audit_chart(found, "title").figure.get_axes()[0]).T
    assert len(x) == 10
    assert y == pytest.approx(x, abs=0.15)


@pytest.mark.parametrize("policies", [1, 3, 8])
def test_every_policy_has_its_panel_and_its_auroc(policies):
    """Two axes per policy, and one with a dot and an interval for each of them."""
    labels, weights = many_labels()
    some = {f"policy {i}": weights["fair"] for i in range(policies)}
    found = audit(labels, some, (), np.random.default_rng(0), replicates=10)
    figure = audit_chart(found, "title").figure
    assert len(figure.get_axes()) == 2 * policies + 1
    last = figure.get_axes()[-1]
    assert len(drawn(last, "dot")) == len(drawn(last, "interval")) == policies
    whole = found.whole()["policy 0"].auroc
    assert places(last)[0, 0] == pytest.approx(whole.value)
    assert sorted(drawn(last, "interval")[0].get_xdata()) == [whole.low, whole.high]
    assert set(some) <= set(texts(figure))
    lines = [text for text in texts(figure) if "at equal recall" in text]
    assert len(lines) == policies
    assert all("by chance up to 0." in text for text in lines)


def test_undefined_values_are_not_drawn():
    """All labels wrong, and no labels at all."""
    wrong = six_labels()
    wrong.correct[:] = False
    for found in (
        small_audit(labels=wrong),
        small_audit({"all": np.zeros(0)}, EvaluatedLabels.no_frames()),
    ):
        chart = audit_chart(found, "title")
        assert not drawn(chart.figure.get_axes()[-1], "dot")
        assert chart.content("png")


def test_the_legend_is_in_the_order_of_the_line_ends():
    """With the last value; a method without results is not in it."""
    nothing = Curve("none", np.full(3, np.nan), np.full(3, np.nan))
    panel = CurvePanel("AP", SHARES, [curve("worse", 20, 20, 21), nothing, curve("best", 1, 2, 60)])
    [axes] = curves_chart([panel], "title", "note").figure.axes
    assert [found.get_text() for found in axes.get_legend().get_texts()] == [
        "best  60.0", "worse  21.0"
    ]  # fmt: skip
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["4 %", "8 %", "16 %"]


@pytest.mark.parametrize("shares", [SHARES[:1], SHARES])
def test_missing_values_are_left_out(shares):
    """A method without spread, one with a gap, a single share; no axis starts below 0."""
    some = np.full(len(shares), 0.5)
    gap = some.copy()
    gap[0] = np.nan
    curves = [Curve("one", some, np.full(len(shares), np.nan)), Curve("gap", gap, 2 * some)]
    figure = curves_chart([CurvePanel("AP", shares, curves)] * 2, "title", "note").figure
    assert len(figure.axes) == 2
    for axes in figure.axes:
        assert axes.get_ylim()[0] >= 0
        lengths = [len(line.get_xdata()) for line in axes.lines]
        assert lengths == [count for count in (len(shares), len(shares) - 1) if count]


def test_lines_have_different_colours_and_markers():
    """For twenty methods."""
    curves = [curve(str(number), *(SHARES + number)) for number in range(20)]
    [axes] = curves_chart([CurvePanel("AP", SHARES, curves)], "title", "note").figure.axes
    assert len({(line.get_color(), line.get_marker()) for line in axes.lines}) == 20


@pytest.mark.parametrize(
    ("suffix", "start"), [("svg", b"<?xml"), ("png", b"\x89PNG"), ("pdf", b"%PDF")]
)
def test_files_have_their_format_and_are_reproducible(tmp_path, suffix, start):
    """No date, no random id."""
    for name in ("a", "b"):
        reliability("r", *BINS).save(tmp_path / f"{name}.{suffix}")
    first, second = ((tmp_path / f"{name}.{suffix}").read_bytes() for name in ("a", "b"))
    assert first.startswith(start)
    assert first == second
    assert b"CreationDate" not in first
    assert b"<dc:date>" not in first


def test_an_inline_chart_takes_its_colours_from_the_page():
    """It is well-formed, describes itself, and loads nothing."""
    text = histogram("loss", np.array([1, 2]), np.array([0, 0.5, 1]), 'a < "b"').inline()
    root = ET.fromstring(text)  # noqa: S314
    assert root.get("aria-label") == 'a < "b": histogram of 3 labels'
    assert "var(--bar)" in text
    assert "#" not in "".join(each.get("style", "") for each in root.iter())
    assert "http" not in text
    assert len(root.findall(".//g[@class='bar']")) == 2
    assert 'a < "b"' in "".join(root.itertext())


def test_an_inline_chart_has_no_ids_that_could_repeat():
    """The tick marks of its axes are drawn nevertheless."""
    root = ET.fromstring(reliability("r", *BINS).inline())  # noqa: S314
    assert not [each for each in root.iter() if each.get("id")]
    assert not root.findall(".//use")
    assert len(root.findall(".//g[@class='dot']//path")) == 3
    assert len(root.findall(".//g[@class='xtick']//path")) >= 3


def test_an_unknown_format_is_an_error():
    """Its message lists the known ones."""
    assert check_format("pdf") == "pdf"
    with pytest.raises(ConfigError, match="--format gif: use svg, png, pdf"):
        check_format("gif")


def test_matplotlib_is_imported_only_to_draw_and_its_settings_are_restored():
    """Not when the charts are imported; pyplot is never imported."""
    code = """
import sys
import numpy as np
from curate.viewing.charts import histogram
assert not any(name.startswith("matplotlib") for name in sys.modules)
from matplotlib import rcParams
before = rcParams.copy()
histogram("a", np.ones(2), np.arange(3), "a").inline()
assert rcParams.copy() == before
assert "matplotlib.pyplot" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
