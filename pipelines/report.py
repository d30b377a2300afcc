"""The report of a round: one HTML file with figures, changes and the labels worth a look."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from sqlalchemy import select

from curate.atomic import replace_file
from curate.viewing.close_up import LabelShown, draw_close_up
from curate.viewing.page import Figure, Section, render_page
from curate.viewing.svg import Mark, histogram, share_curve
from db import bulk
from pipelines.differences import COLUMNS, Difference, difference_of
from pipelines.frame_boxes import chosen_round
from pipelines.label_columns import LabelColumns, read_columns
from pipelines.review.human_labels import counts
from pipelines.workspace import Workspace

_BINS = 40
_PICTURES = 6
_BANDS = (0.0, 20.0, 40.0, 60.0, np.inf)


def write_report(workspace: Workspace, round_number: int | None, policy: str | None) -> Path:
    """Writes the report into the folder `reports` and says where.

    Args:
        workspace: see `Workspace`.
        round_number: None for the last that has predictions.
        policy: whose weights; None for the configured one.

    Raises:
        WorkspaceError: the policy has weighted nothing in that round.
    """
    number = chosen_round(workspace, round_number)
    policy = policy or workspace.config.run.method
    labels = read_columns(workspace, number, policy)
    sections = [
        _figures(labels),
        _categories(labels),
        *_changes(workspace, labels, number, policy),
        _worst(workspace, labels),
        *_reliability(workspace, number, policy),
    ]
    title = f"Round {number}, weights by {policy}"
    kept = int((labels.weights > 0).sum())
    note = (
        f"{len(labels):,} labels in {len(labels.frame_names):,} unlabeled frames, {kept:,} with a "
        f"weight above 0; their weights sum to {labels.weights.sum():,.1f}."
    )
    decided = counts(workspace, number)
    if decided:
        told = ", ".join(f"{count:,} {name}" for name, count in decided.items())
        note += f" People decided on some, whatever the policy says: {told}."
    path = workspace.root / "reports" / f"round-{number:02d}-{policy}.html"
    replace_file(path, render_page(title, note, sections).encode("utf-8"))
    return path


def _figures(labels: LabelColumns) -> Section:
    """Histograms of losses, priors and weights."""
    loss, age = labels.numbers["loss"], labels.numbers["lambda_u"]
    matched, ages = loss[~np.isnan(loss)], np.unique(age[~np.isnan(age)])
    marks = [Mark(float(value), f"λ {value:.3g}") for value in ages[:4]]
    figures = []
    if len(matched):
        counts, edges = np.histogram(matched, _BINS, (0, max(float(matched.max()), 1e-9)))
        unmatched = f"{len(loss) - len(matched):,} labels without a matched reprediction left out"
        figures.append(Figure(histogram(counts, edges, "consistency loss L", marks), unmatched))
    told = {
        "weight": "weight v; 0 means ignore",
        "score": "the detector's score s",
        "rho_diff": "point prior, Eq. 8",
        "rho_anno": "semantic prior, Eq. 9",
        "rho_det": "product of the priors",
    }
    for name, caption in told.items():
        values = labels.numbers[name]
        values = values[~np.isnan(values)]
        if len(values):
            figures.append(Figure(histogram(*np.histogram(values, 20, (0, 1)), name), caption))
    return Section("Losses, priors and weights", figures=figures)


def _categories(labels: LabelColumns) -> Section:
    """A row per category and distance."""
    distance = np.hypot(labels.boxes[:, 0], labels.boxes[:, 1])
    band = np.digitize(distance, _BANDS[1:])
    rows = []
    for c, category in enumerate(labels.category_names):
        for b, (near, far) in enumerate(pairwise(_BANDS)):
            here = (labels.categories == c) & (band == b)
            if here.any():
                place = f"{near:.0f}-{far:.0f} m" if np.isfinite(far) else f"from {near:.0f} m"
                weights = labels.weights[here]
                kept = int((weights > 0).sum())
                total, mean = float(weights.sum()), float(weights.mean())
                score = float(labels.numbers["score"][here].mean())
                rows.append((category, place, int(here.sum()), kept, total, mean, score))
    columns = (
        "category",
        "distance",
        "labels",
        "weight > 0",
        "sum of weights",
        "mean",
        "mean score",
    )
    return Section("Labels by category and distance", columns=columns, rows=rows)


def _changes(
    workspace: Workspace, labels: LabelColumns, number: int, policy: str
) -> Iterator[Section]:
    """What changed since the round before, where the policy weighted that."""
    weight = bulk.table("weight")
    query = select(weight.c.k).where(weight.c.round == number - 1, weight.c.policy == policy)
    with workspace.database.reading() as connection:
        if not bulk.select(connection, query.limit(1)):
            return
    before = read_columns(workspace, number - 1, policy)
    found = difference_of(before, labels, (number - 1, number), policy, _PICTURES)
    note = (
        "Matched one to one by BEV IoU; moved: an IoU below 0.7; heavier, lighter: by 0.05 or more."
    )
    names = [name.replace("_", " ") for name in COLUMNS]
    rows = [tuple(row.values()) for row in found.categories]
    title = f"Since round {number - 1}"
    yield Section(title, note, names, rows, list(_changed(workspace, before, labels, found)))


def _changed(
    workspace: Workspace, before: LabelColumns, after: LabelColumns, found: Difference
) -> Iterator[Figure]:
    """The most changed labels, with their former boxes in dashes."""
    for each in found.labels:
        box = _box(after, each.frame, each.k_after)
        former = _box(before, each.frame, each.k_before)
        shown = former if box is None else box
        if shown is None:
            continue
        label = LabelShown(shown, each.weight_after, former if box is not None else None)
        caption = (
            f"{each.change}: {each.category} in frame {each.frame}, weight "
            f"{each.weight_before:.2f} to {each.weight_after:.2f}"
        )
        yield _close_up(workspace, each.frame, label, caption)


def _worst(workspace: Workspace, labels: LabelColumns) -> Section:
    """Labels that the detector is surest of and the weight is not."""
    doubt = labels.numbers["score"] - labels.weights
    figures = []
    for i in np.argsort(-doubt, kind="stable")[:_PICTURES].tolist():
        frame = labels.frame_names[labels.frames[i]]
        category = labels.category_names[labels.categories[i]]
        told = ", ".join(
            f"{name} {labels.numbers[column][i]:.3g}"
            for name, column in (("score", "score"), ("weight", "weight"), ("L", "loss"),
                                 ("points", "points"), ("rho_anno", "rho_anno"))
            if not np.isnan(labels.numbers[column][i])
        )  # fmt: skip
        caption = f"{category} {labels.k[i]} in frame {frame}: {told}"
        label = LabelShown(labels.boxes[i], float(labels.weights[i]))
        figures.append(_close_up(workspace, frame, label, caption))
    return Section("Most doubted: high score, low weight", figures=figures)


def _reliability(workspace: Workspace, number: int, policy: str) -> Iterator[Section]:
    """A curve per stored audit of the round."""
    bins = bulk.table("audit_bin")
    names = ("frames", "overlap", "mean_weight", "precision", "labels")
    query = (
        select(*(bins.c[name] for name in names))
        .where(bins.c.round == number, bins.c.policy == policy, bins.c.category == "all")
        .order_by(bins.c.frames, bins.c.overlap, bins.c.low)
    )
    with workspace.database.reading() as connection:
        rows = bulk.select(connection, query)
    figures = [
        Figure(
            _curve([row[2:] for row in rows if row[:2] == kind]),
            f"audit on {kind[0]}, right by {kind[1]} overlap",
        )
        for kind in dict.fromkeys(row[:2] for row in rows)
    ]
    if figures:
        note = (
            "Share of right labels over their mean weight; on the diagonal it means what it says."
        )
        yield Section("Reliability", note, figures=figures)


def _curve(rows: Sequence[Sequence[float]]) -> str:
    table = np.array(rows, dtype=np.float64)
    table = table[~np.isnan(table).any(axis=1)]
    return share_curve(table[:, 0], table[:, 1], table[:, 2], "mean weight of the bin")


def _box(labels: LabelColumns, frame: str, k: int | None) -> np.ndarray | None:
    """(7,) box of a label; None for no label."""
    if k is None:
        return None
    place = labels.frame_names.index(frame)
    box: np.ndarray = labels.boxes[(labels.frames == place) & (labels.k == k)][0]
    return box


def _close_up(workspace: Workspace, name: str, label: LabelShown, caption: str) -> Figure:
    frame = workspace.dataset.read(name, image=True)
    return Figure.picture(draw_close_up(frame, label), caption)
