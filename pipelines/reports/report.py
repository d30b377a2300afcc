"""The report of a round: one HTML file with figures, changes and close-ups of notable labels."""

from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path

import numpy as np
from sqlalchemy import select

from curate.files.atomic import replace_file
from curate.viewing.chart_style import Chart, ImageFormat
from curate.viewing.charts import reliability
from curate.viewing.close_up import CloseUpLabel, draw_close_up
from curate.viewing.page import Figure, Section, render_page
from db import bulk
from db.views import WEIGHTED_LABELS
from pipelines.labels.by_frame import chosen_round, weighted_round
from pipelines.labels.columns import read_blocks, read_frame_columns
from pipelines.labels.human_labels import counts
from pipelines.reports.differences import COLUMNS, ChangedLabel, Comparison, Difference
from pipelines.reports.figures import (
    beside_others,
    by_category,
    distributions,
    is_repredicted,
    summary,
)
from pipelines.reports.totals import RankedLabel, Ranking, RoundTotals, extent, read_shares
from pipelines.workspace.workspace import Workspace

_PICTURES = 6


def write_report(
    workspace: Workspace,
    round_number: int | None,
    policy: str | None,
    kind: ImageFormat | None = None,
) -> tuple[Path, list[Path]]:
    """Write the report into the folder `reports`; return its path and the paths of its charts.

    Args:
        workspace: see `Workspace`.
        round_number: the round; None for the last round that the policy weighted.
        policy: the policy that gave the weights; None for the configured one.
        kind: format of chart files, which are written to a folder next to the report; None for no
            chart files.

    Raises:
        WorkspaceError: if the policy has no weights in the round.
    """
    policy = policy or workspace.config.run.method
    number = chosen_round(workspace, round_number or weighted_round(workspace, policy))
    totals = RoundTotals(extent(workspace, number, policy), read_shares(workspace))
    repredicted = is_repredicted(workspace, number)
    doubted, kept = Ranking(_PICTURES), Ranking(_PICTURES)
    comparison = Comparison(_PICTURES)
    before = _round_before(workspace, number, policy)
    rounds = (number,) if before is None else (number, before)
    for labels, *previous in read_blocks(workspace, rounds, policy):
        score = labels.numbers["score"]
        totals.add(labels)
        doubted.add(labels, score - labels.weights)
        kept.add(labels, np.where(score < 0.5, labels.weights, 0.0))
        for each in previous:
            comparison.add(each, labels)
    rejected = _rejected(workspace, number, policy, doubted)
    priors = [name for name in totals.shares if name not in ("weight", "score", "rho_det")]
    sections = [
        summary(workspace, totals, number, policy, repredicted=repredicted),
        distributions(totals),
        by_category(totals, workspace.config.dataset.categories),
        *beside_others(workspace, number, policy),
        *(
            []
            if before is None
            else _changes(workspace, comparison.finish((before, number), policy))
        ),
        *(
            _shown(workspace, heading, ranking, rejected, priors, repredicted=repredicted)
            for heading, ranking in (
                ("High score, low weight", doubted),
                ("Low score (below 0.5), high weight", kept),
            )
        ),
        *_reliability(workspace, number, policy),
    ]
    title = f"Round {number}, weights by {policy}"
    note = f"workspace {workspace.root.name}, data set {workspace.config.dataset.kind}"
    decided = counts(workspace, number)
    if decided:
        summary_of_decisions = ", ".join(f"{count:,} {name}" for name, count in decided.items())
        note += f". Decisions by people, which override the policy: {summary_of_decisions}."
    path = workspace.root / "reports" / f"round-{number:02d}-{policy}.html"
    replace_file(path, render_page(title, note, sections).encode("utf-8"))
    charts = [each.chart for section in sections for each in section.figures if each.chart]
    return path, _save(charts, path.with_suffix(""), kind) if kind else []


def _save(charts: Sequence[Chart], folder: Path, kind: ImageFormat) -> list[Path]:
    """Write each chart into a folder."""
    paths = [folder / f"{chart.name}.{kind}" for chart in charts]
    for chart, path in zip(charts, paths, strict=True):
        chart.save(path)
    return paths


def _round_before(workspace: Workspace, number: int, policy: str) -> int | None:
    """Return the previous round, or None if the policy has no weights in it."""
    weight = bulk.table("weight")
    query = select(weight.c.k).where(weight.c.round == number - 1, weight.c.policy == policy)
    return number - 1 if workspace.database.rows(query.limit(1)) else None


def _changes(workspace: Workspace, found: Difference) -> Iterator[Section]:
    """Yield the section with the changes since the previous round."""
    note = (
        "Matched one to one by BEV IoU; moved: an IoU below 0.7; heavier, lighter: by 0.05 or more."
    )
    names = [name.replace("_", " ") for name in COLUMNS]
    rows = [tuple(row.values()) for row in found.categories]
    figures = [_changed(workspace, found, each) for each in found.labels]
    yield Section(f"Since round {found.rounds[0]}", note, names, rows, figures)


def _changed(workspace: Workspace, found: Difference, each: ChangedLabel) -> Figure:
    """Return a close-up of a changed label, with its previous box dashed."""
    boxes = [
        _box(workspace, number, found.policy, each.frame, k)
        for number, k in zip(found.rounds, (each.k_before, each.k_after), strict=True)
        if k is not None
    ]
    label = CloseUpLabel(boxes[-1], each.weight_after, boxes[0] if len(boxes) == 2 else None)
    caption = (
        f"{each.change}: {each.category} in frame {each.frame}, weight "
        f"{each.weight_before:.2f} to {each.weight_after:.2f}"
    )
    return _close_up(workspace, each.frame, label, caption)


def _rejected(
    workspace: Workspace, number: int, policy: str, ranking: Ranking
) -> AbstractSet[tuple[str, int]]:
    """Return frame and k of the labels that people rejected, in the frames of a ranking."""
    labels = WEIGHTED_LABELS.c
    query = select(labels.frame, labels.k).where(
        labels.round == number,
        labels.policy == policy,
        labels.frame.in_(sorted({each.frame for each in ranking.labels})),
        labels.provenance == "human",
        labels.weight == 0,
    )
    return {(frame, k) for frame, k in workspace.database.rows(query)}


def _shown(
    workspace: Workspace,
    title: str,
    ranking: Ranking,
    rejected: AbstractSet[tuple[str, int]],
    priors: Sequence[str],
    *,
    repredicted: bool,
) -> Section:
    """Return the section with close-ups of the labels of a ranking."""
    figures = [
        _close_up(
            workspace,
            each.frame,
            CloseUpLabel(each.box, each.numbers["weight"]),
            _describe_label(
                each,
                priors,
                rejected=(each.frame, each.k) in rejected,
                repredicted=repredicted,
            ),
        )
        for each in ranking.labels
    ]
    return Section(title, "" if figures else "There are no such labels.", figures=figures)


def _describe_label(
    label: RankedLabel, priors: Sequence[str], *, rejected: bool, repredicted: bool
) -> str:
    """Return the caption of a label: its numbers, and the reasons for a weight of 0."""
    values = label.numbers
    numbers = ", ".join(
        f"{name} {_figure(value)}" for name, value in values.items() if not np.isnan(value)
    )
    reasons = {
        "no reprediction matched it": repredicted and np.isnan(values["loss"]),
        "its loss is above lambda": values["loss"] >= values["lambda_u"],
    }
    # The trusts are factors of the weight: one trust of 0 is enough.
    reasons |= {f"{name} is 0": values[name] == 0 for name in priors}
    if rejected:
        reasons = {"a person rejected it": True}
    found = [reason for reason, holds in reasons.items() if holds and values["weight"] <= 0]
    return f"{label.category} {label.k} in frame {label.frame}: {numbers}" + "".join(
        f"; {reason}" for reason in found
    )


def _figure(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _reliability(workspace: Workspace, number: int, policy: str) -> Iterator[Section]:
    """Yield the section with a chart for each stored audit of the round."""
    bins = bulk.table("audit_bin")
    names = ("frames", "overlap", "mean_weight", "precision", "labels")
    query = (
        select(*(bins.c[name] for name in names))
        .where(bins.c.round == number, bins.c.policy == policy, bins.c.category == "all")
        .order_by(bins.c.frames, bins.c.overlap, bins.c.low)
    )
    rows = workspace.database.rows(query)
    figures = [
        Figure.of_chart(
            _chart(
                f"reliability-{kind[0].replace(' ', '-')}-{kind[1]}",
                [row[2:] for row in rows if row[:2] == kind],
            ),
            f"audit on {kind[0]}, correct by {kind[1]} overlap",
        )
        for kind in dict.fromkeys(row[:2] for row in rows)
    ]
    if figures:
        note = (
            "Share of correct labels over their mean weight, with 95 % Wilson intervals. The "
            "diagonal is perfect calibration. Hollow dots have fewer than 10 labels."
        )
        yield Section("Reliability", note, figures=figures)


def _chart(name: str, rows: Sequence[Sequence[float]]) -> Chart:
    table = np.array(rows, dtype=np.float64)
    table = table[~np.isnan(table).any(axis=1)]
    return reliability(name, *table.T)


def _box(workspace: Workspace, number: int, policy: str, frame: str, k: int) -> np.ndarray:
    """Return the (7,) box of a label."""
    labels = read_frame_columns(workspace, number, policy, frame)
    box: np.ndarray = labels.boxes[labels.k == k][0]
    return box


def _close_up(workspace: Workspace, name: str, label: CloseUpLabel, caption: str) -> Figure:
    frame = workspace.dataset.read(name, image=True)
    return Figure.of_image(draw_close_up(frame, label), caption)
