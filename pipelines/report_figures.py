"""The figures of a report: what a round's losses, priors and weights are, all labels together."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from sqlalchemy import case, func, select

from curate.viewing.page import ALL, Figure, Section
from curate.viewing.svg import Mark, histogram
from db import bulk
from pipelines.label_columns import LabelColumns
from pipelines.workspace import Workspace

_LOSS_BINS, _BINS = 40, 25
_BANDS = (0.0, 20.0, 40.0, 60.0, np.inf)
_TOLD = {
    "weight": "the weight v",
    "score": "the detector's score s",
    "rho_diff": "the point prior (Eq. 8)",
    "rho_anno": "the semantic prior (Eq. 9)",
    "rho_det": "the product of the priors",
}


def summary(workspace: Workspace, labels: LabelColumns, number: int) -> Section:
    """The round in a few numbers."""
    weights, n = labels.weights, len(labels)
    matched = int((~np.isnan(labels.numbers["loss"])).sum())
    kept, trusted = int((weights > 0).sum()), int((weights > 0.5).sum())
    facts = [
        ("labels", f"{n:,}"),
        ("unlabeled frames", f"{len(labels.frame_names):,}"),
        ("weight above 0", f"{kept:,} ({kept / n:.1%})"),
        ("weight above 0.5", f"{trusted:,} ({trusted / n:.1%})"),
        ("sum of weights", f"{weights.sum():,.1f}"),
        ("matched again", f"{matched:,} ({matched / n:.1%})"),
    ]
    ages = labels.numbers["lambda_u"][~np.isnan(labels.numbers["lambda_u"])]
    if len(ages):
        low, high = float(ages.min()), float(ages.max())
        facts.append(("lambda", f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"))
    facts.append(("age e/E", _age(workspace, number)))
    note = (
        f"{n:,} labels in {len(labels.frame_names):,} unlabeled frames, {kept:,} with a weight "
        "above 0; the others mark regions to ignore."
    )
    return Section("The round", note, facts=facts)


def distributions(labels: LabelColumns) -> Section:
    """Histograms of losses, priors and weights."""
    loss, age = labels.numbers["loss"], labels.numbers["lambda_u"]
    matched, ages = loss[~np.isnan(loss)], np.unique(age[~np.isnan(age)])
    marks = [Mark(float(value), f"λ {value:.3g}") for value in ages[:4]]
    figures = []
    if len(matched):
        reach = max(float(matched.max()), float(ages[0]) if len(ages) else 0.0, 1e-9) * 1.02
        counts, edges = np.histogram(matched, _LOSS_BINS, (0, reach))
        unmatched = (
            f"the loss of {len(matched):,} labels; {len(loss) - len(matched):,} without a matched "
            "reprediction left out"
        )
        figures.append(Figure(histogram(counts, edges, "consistency loss L", marks), unmatched))
    for name, told in _TOLD.items():
        values = labels.numbers[name]
        above = values[values > 0]
        if len(above) == 0:
            continue
        zeros = int((values == 0).sum())
        # Most weights are 0: in the same chart they would flatten all others.
        left_out = f"; {zeros:,} labels with 0 left out" if zeros else ""
        chart = histogram(*np.histogram(above, _BINS, (0, 1)), name)
        figures.append(Figure(chart, f"{told} of {len(above):,} labels{left_out}"))
    return Section("Losses, priors and weights", figures=figures)


def by_category(labels: LabelColumns) -> Section:
    """A row per category and distance, and the sums."""
    distance = np.hypot(labels.boxes[:, 0], labels.boxes[:, 1])
    band = np.digitize(distance, _BANDS[1:])
    everything = np.full(len(labels), True)
    rows = []
    for c, category in enumerate(labels.category_names):
        own = labels.categories == c
        if not own.any():
            continue
        rows.append((category, ALL, *_sums(labels, own)))
        for b, (near, far) in enumerate(pairwise(_BANDS)):
            here = own & (band == b)
            if here.any():
                place = f"{near:.0f}-{far:.0f} m" if np.isfinite(far) else f"from {near:.0f} m"
                rows.append((category, place, *_sums(labels, here)))
    rows.append((ALL, "", *_sums(labels, everything)))
    columns = (
        "category", "distance", "labels", "weight > 0", "share kept", "sum of weights",
        "mean weight", "mean score",
    )  # fmt: skip
    return Section("Labels by category and distance", columns=columns, rows=rows)


def beside_others(workspace: Workspace, number: int, policy: str) -> Iterator[Section]:
    """The policies that weighted the same labels, where there are several."""
    weight, frame = bulk.table("weight"), bulk.table("frame")
    above = [func.sum(case((weight.c.v > least, 1), else_=0)) for least in (0, 0.5)]
    query = (
        select(weight.c.policy, func.count(), *above, func.sum(weight.c.v), func.avg(weight.c.v))
        .join(frame, frame.c.id == weight.c.frame_id)
        .where(weight.c.round == number, frame.c.split == "unlabeled")
        .group_by(weight.c.policy)
        .order_by(weight.c.policy)
    )
    with workspace.database.reading() as connection:
        rows = [
            (f"{row[0]} (this page)" if row[0] == policy else row[0], *map(int, row[1:4]), *row[4:])
            for row in bulk.select(connection, query)
        ]
    if len(rows) > 1:
        columns = ("policy", "labels", "weight > 0", "weight > 0.5", "sum of weights", "mean")
        note = "The same labels under every policy that has weighted them in this round."
        yield Section("Beside other policies", note, columns, rows)


def _sums(labels: LabelColumns, here: np.ndarray) -> tuple[int, int, float, float, float, float]:
    """Labels, kept ones, their share, and the sum and means of weight and score."""
    weights = labels.weights[here]
    count, kept = int(here.sum()), int((weights > 0).sum())
    score = float(labels.numbers["score"][here].mean())
    return count, kept, kept / count, float(weights.sum()), float(weights.mean()), score


def _age(workspace: Workspace, number: int) -> str:
    """The round and of how many it is, as it was made."""
    table = bulk.table("round")
    query = select(table.c.rounds).where(table.c.number == number)
    with workspace.database.reading() as connection:
        rows = bulk.select(connection, query)
    return f"{number}/{rows[0][0]}" if rows else str(number)
