"""Bar charts, and a curve against the diagonal, as inline SVG; the page's CSS colours them."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

_WIDTH, _HEIGHT = 440, 230
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 14, 16, 40


@dataclass(frozen=True)
class Mark:
    """A vertical line over a chart.

    Attributes:
        place: on the horizontal axis.
        name: written beside it.
    """

    place: float
    name: str


def histogram(counts: np.ndarray, edges: np.ndarray, axis: str, marks: Sequence[Mark] = ()) -> str:
    """Bars of (n,) counts between (n + 1,) rising edges.

    Args:
        counts: not negative.
        edges: of the bars.
        axis: what runs across.
        marks: drawn over the bars, where they lie within the edges.
    """
    most = max(float(counts.max(initial=0)), 1.0)
    span = float(edges[-1] - edges[0]) or 1.0
    across = _LEFT + (edges - edges[0]) / span * (_WIDTH - _LEFT - _RIGHT)
    parts = [_frame(axis, f"{axis}: histogram of {int(counts.sum())} labels")]
    parts += [_tick_y(share, _count(share * most)) for share in (0.0, 0.5, 1.0)]
    parts += [
        _tick_x(across[0] + share * (across[-1] - across[0]), f"{edges[0] + share * span:.3g}")
        for share in (0.0, 0.5, 1.0)
    ]
    for i, count in enumerate(counts.tolist()):
        top = _down(count / most)
        told = f"{edges[i]:.3g} to {edges[i + 1]:.3g}: {count:,.0f}"
        parts.append(_bar(across[i], across[i + 1], top, told))
    for mark in marks:
        if edges[0] <= mark.place <= edges[-1]:
            parts.append(_mark(_LEFT + (mark.place - edges[0]) / span * (across[-1] - _LEFT), mark))
    return "".join([*parts, "</svg>"])


def share_curve(places: np.ndarray, shares: np.ndarray, counts: np.ndarray, axis: str) -> str:
    """Shares in [0, 1] over places in [0, 1] beside the diagonal, as dots that tell their count."""
    parts = [_frame(axis, axis)]
    parts += [_tick_y(share, f"{share:g}") for share in (0.0, 0.5, 1.0)]
    wide = _WIDTH - _LEFT - _RIGHT
    parts += [_tick_x(_LEFT + share * wide, f"{share:g}") for share in (0.0, 0.5, 1.0)]
    parts.append(
        f'<line class="diagonal" x1="{_LEFT}" y1="{_down(0):.1f}" x2="{_LEFT + wide}" '
        f'y2="{_down(1):.1f}"/>'
    )
    dots = [
        (_LEFT + place * wide, _down(share)) for place, share in zip(places, shares, strict=True)
    ]
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in dots)
    parts.append(f'<polyline class="curve" points="{line}"/>')
    for (x, y), count, share in zip(dots, counts.tolist(), shares.tolist(), strict=True):
        told = f"{share:.2f} of {count:,.0f} labels are right"
        parts.append(
            f'<circle class="dot" cx="{x:.1f}" cy="{y:.1f}" r="3.5"><title>{told}</title></circle>'
        )
    return "".join([*parts, "</svg>"])


def _frame(axis: str, told: str) -> str:
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(told)}">'
        f'<text class="axis" x="{middle:.0f}" y="{_HEIGHT - 6}" text-anchor="middle">'
        f"{escape(axis)}</text>"
    )


def _count(value: float) -> str:
    """A count that has room beside an axis."""
    return f"{value:,.0f}" if value < 1e6 else f"{value / 1e6:,.3g} M"


def _down(share: float) -> float:
    return float(_HEIGHT - _BOTTOM - share * (_HEIGHT - _TOP - _BOTTOM))


def _tick_y(share: float, text: str) -> str:
    level = _down(share)
    return (
        f'<line class="grid" x1="{_LEFT}" y1="{level:.1f}" x2="{_WIDTH - _RIGHT}" '
        f'y2="{level:.1f}"/>'
        f'<text class="tick" x="{_LEFT - 6}" y="{level + 4:.1f}" text-anchor="end">{text}</text>'
    )


def _tick_x(place: float, text: str) -> str:
    return (
        f'<text class="tick" x="{place:.1f}" y="{_HEIGHT - _BOTTOM + 15}" '
        f'text-anchor="middle">{text}</text>'
    )


def _bar(left: float, right: float, top: float, told: str) -> str:
    width = max(right - left - 1, 0.5)
    return (
        f'<rect class="bar" x="{left + 0.5:.1f}" y="{top:.1f}" width="{width:.1f}" '
        f'height="{_down(0) - top:.1f}"><title>{told}</title></rect>'
    )


def _mark(place: float, mark: Mark) -> str:
    side, shift = ("end", -5) if place > _WIDTH * 0.65 else ("start", 5)
    return (
        f'<line class="mark" x1="{place:.1f}" y1="{_TOP - 6}" x2="{place:.1f}" '
        f'y2="{_down(0):.1f}"/>'
        f'<text class="marked" x="{place + shift:.1f}" y="{_TOP + 4}" text-anchor="{side}">'
        f"{escape(mark.name)}</text>"
    )
