"""The charts of reports, audits and benchmarks; see `chart_style` for their style."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from curate.evaluation.audit import Audit, Estimate, Figures
from curate.viewing.chart_style import (
    BAR,
    FAINT,
    GROUND,
    INK,
    MARK,
    RULE,
    Chart,
    chart_style,
    new_figure,
    unclip,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

_FEW_LABELS = 10
_COLUMNS = 4
_READING_AID = (
    "dots: share of correct labels in each tenth of the weight range, at their mean weight; dashed "
    "line: perfect calibration; bars: {level:.0f} % Wilson interval; hollow: fewer than "
    f"{_FEW_LABELS} labels; below: number of labels, log scale; ECE: calibration error, and what "
    "perfectly calibrated weights would have; precision: share of the weight on correct labels"
)
# Okabe and Ito's colours, which colour-blind readers can distinguish, each with its own marker.
_LINES = (
    "#5b6675", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7a5230", "#0072b2",
    "#1b2129",
)  # fmt: skip
_MARKERS = "osD^v<>PXh"


@dataclass(frozen=True)
class Mark:
    """A vertical line over a chart.

    Attributes:
        place: position on the horizontal axis.
        name: text beside the line.
    """

    place: float
    name: str


@dataclass(frozen=True)
class Curve:
    """A line of a `CurvePanel`.

    Attributes:
        name: name in the legend.
        means: (n,) one value per share; NaN if missing.
        stds: (n,) half the length of the error bars; NaN for no bar.
    """

    name: str
    means: np.ndarray
    stds: np.ndarray


@dataclass(frozen=True)
class CurvePanel:
    """Several lines over the same shares of labeled frames.

    Attributes:
        title: title of the panel.
        shares: (n,) ascending, above 0; the axis is logarithmic.
        curves: the lines.
    """

    title: str
    shares: np.ndarray
    curves: Sequence[Curve]


def histogram(
    name: str, counts: np.ndarray, edges: np.ndarray, axis: str, marks: Sequence[Mark] = ()
) -> Chart:
    """Return a histogram of counts.

    Args:
        name: name of the chart.
        counts: (n,) not negative.
        edges: (n + 1,) edges of the bins, ascending.
        axis: label of the horizontal axis.
        marks: lines over the bars; marks outside the edges are omitted.
    """
    with chart_style():
        figure = new_figure(4.6, 2.4)
        axes = figure.add_subplot()
        bars = axes.bar(edges[:-1], counts, np.diff(edges), align="edge", color=BAR, ec=GROUND)
        for bar in bars:
            bar.set_gid("bar")
            bar.set_linewidth(0.6)
        axes.set(xlim=(edges[0], edges[-1]), xlabel=axis, ylabel="labels")
        shown = [mark for mark in marks if edges[0] <= mark.place <= edges[-1]]
        room = 1.06 + 0.09 * len(shown)
        axes.set_ylim(0, max(1.0, room * float(counts.max(initial=0))))
        axes.grid(visible=False, axis="x")
        _whole_numbers(axes)
        for row, mark in enumerate(shown):
            axes.axvline(mark.place, color=MARK, lw=1.4, gid="mark")
            right = mark.place - edges[0] > 0.65 * (edges[-1] - edges[0])
            axes.annotate(
                mark.name, (mark.place, 1.0), (-4 if right else 4, -1 - 11 * row),
                xycoords=("data", "axes fraction"), textcoords="offset points", color=MARK,
                ha="right" if right else "left", va="top",
                bbox={"fc": GROUND, "ec": "none", "pad": 0.6},
            )  # fmt: skip
        unclip(axes)
    return Chart(name, f"{axis}: histogram of {int(counts.sum()):,} labels", figure)


def reliability(
    name: str, weights: np.ndarray, shares: np.ndarray, labels: np.ndarray, level: float = 0.95
) -> Chart:
    """Return a reliability diagram: the share of correct labels over the mean weight, by bin.

    Args:
        name: name of the chart.
        weights: (b,) mean weight of each bin; NaN in an empty bin.
        shares: (b,) share of correct labels in each bin.
        labels: (b,) number of labels in each bin.
        level: coverage of the intervals.
    """
    with chart_style():
        figure = new_figure(4.6, 3.4)
        _draw_reliability(figure, (weights, shares, labels), level)
    return Chart(name, "share of correct labels over their mean weight", figure)


def audit_chart(audit: Audit, title: str) -> Chart:
    """Return a reliability diagram for each policy, and the AUROC of all policies.

    Args:
        audit: the audit; the chart shows its figures over all categories, distances and points.
        title: text at the top.
    """
    found = list(audit.whole().values())
    columns = min(_COLUMNS, len(found) + 1)
    rows = -(-(len(found) + 1) // columns)
    with chart_style():
        figure = new_figure(3.1 * columns, 3.3 * rows + 0.9)
        labels = f"; {audit.frames:,} frames, {found[0].labels:,} labels" if found else ""
        figure.suptitle(title + labels, x=0.01, ha="left", fontsize=11)
        figure.supxlabel(
            _wrapped(_READING_AID.format(level=100 * audit.level), 46 * columns),
            x=0.01, ha="left", fontsize=7.5, color=FAINT,
        )  # fmt: skip
        cells = figure.subfigures(rows, columns, squeeze=False).flat
        for each in found:
            bins = each.bins
            axes = _draw_reliability(
                next(cells), (bins.mean_weight, bins.precision, bins.labels), audit.level
            )
            _write_figures(axes, each)
        _draw_aurocs(next(cells).add_subplot(), found, audit.level, audit.resampled)
    return Chart("audit", title, figure)


def curves_chart(panels: Sequence[CurvePanel], title: str, note: str) -> Chart:
    """Return AP with error bars over the share of labeled frames, in panels side by side.

    Args:
        panels: one or more panels.
        title: text at the top.
        note: text below, which explains lines and bars.
    """
    with chart_style():
        figure = new_figure(5.6 * len(panels), 4.4)
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        figure.supxlabel(
            _wrapped(note, 92 * len(panels)), x=0.01, ha="left", fontsize=7.5, color=FAINT
        )
        for number, panel in enumerate(panels):
            _draw_curves(figure.add_subplot(1, len(panels), number + 1), panel)
    return Chart("curve", title, figure)


def _draw_reliability(
    figure: "FigureBase", bins: tuple[np.ndarray, np.ndarray, np.ndarray], level: float
) -> "Axes":
    """Draw dots with intervals and, below them, the number of labels of each dot."""
    from scipy.stats import binomtest

    grid = figure.add_gridspec(2, 1, height_ratios=(4, 1.3), hspace=0.02)
    axes = figure.add_subplot(grid[0])
    counted = figure.add_subplot(grid[1], sharex=axes)
    axes.plot([0, 1], [0, 1], color=FAINT, lw=1, ls=(0, (4, 4)), gid="diagonal")
    weights, shares, labels = (values[bins[2] > 0] for values in bins)
    for weight, share, count in zip(weights, shares, labels.astype(int), strict=True):
        found = binomtest(round(share * count), int(count)).proportion_ci(level, method="wilson")
        axes.plot([weight, weight], [found.low, found.high], color=BAR, lw=1.2, gid="interval")
        few = count < _FEW_LABELS
        axes.plot(
            weight, share, "o", ms=5, color=BAR, mfc=GROUND if few else BAR, zorder=3, gid="dot"
        )
    axes.set(xlim=(0, 1), ylim=(0, 1), ylabel="share correct")
    axes.set_yticks([0, 0.5, 1])
    axes.tick_params(labelbottom=False)
    # A bar is as wide as the smallest gap between dots allows, so that bars do not overlap.
    gap = float(np.diff(weights).min(initial=0.08))
    counted.bar(weights, np.log10(1 + labels), min(0.06, 0.8 * gap), color=RULE, gid="count")
    most = float(np.log10(1 + labels.max(initial=1)))
    for weight, count in zip(weights, labels.astype(int), strict=True):
        counted.annotate(
            _short_count(int(count)), (weight, np.log10(1 + count)), (0, 1.5),
            textcoords="offset points", ha="center", fontsize=6.5, color=FAINT,
        )  # fmt: skip
    counted.set(ylim=(0, 1.5 * most), xlabel="mean weight", yticks=[], ylabel="labels")
    counted.set_xticks([0, 0.5, 1])
    counted.spines["left"].set_visible(False)
    counted.grid(visible=False)
    figure.align_ylabels([axes, counted])
    for each in (axes, counted):
        unclip(each)
    return axes


def _write_figures(axes: "Axes", figures: Figures) -> None:
    """Write a policy's name and figures above its panel."""
    axes.set_title(figures.policy, pad=26)
    error, limit = _format(figures.calibration_error), _number(figures.calibration_error_limit)
    precision, equal = map(_format, (figures.weighted_precision, figures.equal_recall_precision))
    lines = (
        f"AUROC {_format(figures.auroc)}   ECE {error}, by chance up to {limit}",
        f"precision {precision}, at equal recall {equal}",
    )
    axes.annotate(
        "\n".join(lines), (0, 1), (0, 5), xycoords="axes fraction", textcoords="offset points",
        fontsize=7.5, color=FAINT,
    )  # fmt: skip


def _draw_aurocs(axes: "Axes", found: Sequence[Figures], level: float, over: str) -> None:
    """Draw the AUROC of each policy with its interval, the best on top."""
    axes.set_title("AUROC", pad=26)
    axes.annotate(
        f"correct ranked above wrong labels\nbars: {100 * level:.0f} % interval over {over}",
        (0, 1), (0, 5), xycoords="axes fraction", textcoords="offset points", fontsize=7.5,
        color=FAINT,
    )  # fmt: skip
    defined = sorted(
        (each for each in found if not np.isnan(each.auroc.value)), key=lambda e: e.auroc.value
    )
    axes.grid(visible=False, axis="y")
    axes.spines["left"].set_visible(False)
    if not defined:
        axes.set(xlim=(0.5, 1), yticks=[])
        axes.text(
            0.75,
            0.5,
            "undefined: all labels are correct,\nor all are wrong, or nothing\nwas measured",
            ha="center",
        )
        return
    for row, each in enumerate(defined):
        value, low, high = each.auroc.value, each.auroc.low, each.auroc.high
        axes.plot([low, high], [row, row], color=BAR, lw=1.6, gid="interval")
        axes.plot(value, row, "o", ms=5, color=BAR, gid="dot")
        for text, place, side in ((each.policy, 0, "left"), (f"{value:.3f}", 1, "right")):
            axes.annotate(
                text, (place, row), (0, 5), xycoords=("axes fraction", "data"),
                textcoords="offset points", ha=side, color=INK,
            )  # fmt: skip
    lowest = min(float(np.nanmin([each.auroc.low, each.auroc.value])) for each in defined)
    axes.set_xlim(min(0.5, np.floor(10 * lowest) / 10), 1)
    axes.locator_params(axis="x", nbins=3)
    axes.set_ylim(len(defined) - max(len(defined), 4) - 0.6, len(defined) - 0.3)
    axes.set_yticks([])
    unclip(axes)


def _draw_curves(axes: "Axes", panel: CurvePanel) -> None:
    """Draw the lines with a legend that is sorted by their last values."""
    axes.set_title(panel.title)
    axes.set_xscale("log")
    order = []
    for number, curve in enumerate(panel.curves):
        defined = ~np.isnan(curve.means)
        if not defined.any():
            continue
        # Each curve is shifted a little, because error bars at the same place hide each other.
        shift = 1.012 ** (number - (len(panel.curves) - 1) / 2)
        drawn = axes.errorbar(
            panel.shares[defined] * shift, curve.means[defined],
            np.nan_to_num(curve.stds[defined]),
            color=_LINES[number % len(_LINES)], marker=_MARKERS[number % len(_MARKERS)], ms=4.5,
            lw=1.3, elinewidth=1, capsize=0, gid="curve",
        )  # fmt: skip
        last = float(curve.means[defined][-1])
        drawn.set_label(f"{curve.name}  {last:.1f}")
        order.append((last, drawn))
    axes.set_ylim(bottom=max(0.0, axes.get_ylim()[0]))
    axes.set_xticks(panel.shares, [f"{100 * share:g} %" for share in panel.shares])
    axes.set_xticks([], minor=True)
    if len(panel.shares) == 1:
        axes.set_xlim(panel.shares[0] / 1.5, panel.shares[0] * 1.5)
    axes.set(xlabel="labeled frames", ylabel="AP, %")
    axes.grid(visible=False, axis="x")
    ranked = [drawn for _, drawn in sorted(order, key=lambda each: -each[0])]
    if ranked:
        axes.legend(handles=ranked, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _whole_numbers(axes: "Axes") -> None:
    """Label the vertical axis with a few whole numbers, with commas."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))


def _wrapped(text: str, width: int) -> str:
    from textwrap import fill

    return fill(text, width)


def _format(estimate: Estimate) -> str:
    return _number(estimate.value)


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2f}"


def _short_count(labels: int) -> str:
    return f"{labels / 1000:.0f}k" if labels >= 10_000 else str(labels)
