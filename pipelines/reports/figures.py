"""The sections of a report with tables and charts of losses, priors and weights of a round."""

from collections.abc import Iterator

import numpy as np
from sqlalchemy import select, text

from curate.viewing.charts import Mark, histogram
from curate.viewing.page import ALL, Figure, Section
from db import bulk
from pipelines.queries.named_queries import find_query
from pipelines.reports.totals import BANDS, SHOWN_AGES, RoundTotals, Sums
from pipelines.stages.methods import ZERO_WEIGHT_WORDS, zero_weight_of
from pipelines.workspace.workspace import Workspace


def is_repredicted(workspace: Workspace, number: int) -> bool:
    """Return whether the round has a second pass over augmented copies."""
    view = bulk.table("reprediction_view")
    query = select(view.c.round).where(view.c.round == number).limit(1)
    return bool(workspace.database.rows(query))


def summary(
    workspace: Workspace, totals: RoundTotals, number: int, policy: str, *, repredicted: bool
) -> Section:
    """Return the section with the key figures of the round."""
    n, kept, trusted = totals.everything.labels, totals.everything.kept, totals.trusted
    facts = [
        ("labels", f"{n:,}"),
        ("unlabeled frames", f"{totals.frames:,}"),
        ("weight above 0", f"{kept:,} ({kept / n:.1%})"),
        ("weight above 0.5", f"{trusted:,} ({trusted / n:.1%})"),
        ("sum of weights", f"{totals.everything.weight:,.1f}"),
        (
            "matched by a reprediction",
            f"{totals.matched:,} ({totals.matched / n:.1%})" if repredicted else "no second pass",
        ),
    ]
    if len(totals.ages):
        low, high = float(totals.ages[0]), float(totals.ages[-1])
        facts.append(("lambda", f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"))
    facts.append(("age e/E", _age(workspace, number)))
    if totals.unseen is not None:
        facts.append(("without image evidence", f"{totals.unseen:,} ({totals.unseen / n:.1%})"))
    note = (
        f"{n:,} labels in {totals.frames:,} unlabeled frames, {kept:,} with a weight "
        f"above 0; the others are {ZERO_WEIGHT_WORDS[zero_weight_of(workspace.config, policy)]}."
    )
    if totals.unseen:
        without, with_images = totals.heaviest
        note += (
            f" No camera shows {totals.unseen:,} of the labels (semantic.outside = "
            f"'{workspace.config.semantic.outside}'): their highest weight is {without:.4g}, that "
            f"of a label with image evidence {with_images:.4g}."
        )
    return Section("The round", note, facts=facts)


def distributions(totals: RoundTotals) -> Section:
    """Return the section with histograms of losses, priors and weights."""
    n, loss = totals.everything.labels, totals.histograms["loss"]
    marks = [Mark(float(value), f"λ {value:.3g}") for value in totals.ages[:SHOWN_AGES]]
    figures = []
    if totals.matched:
        unmatched = (
            f"the loss of {totals.matched:,} labels; {n - totals.matched:,} labels without a "
            "matched reprediction are not included"
        )
        chart = histogram("loss", loss.counts, loss.edges, "consistency loss L", marks)
        figures.append(Figure.of_chart(chart, unmatched))
    for name, meaning in totals.shares.items():
        found = totals.histograms[name]
        if not found.above:
            continue
        # Most weights are 0; a bar for them would make all other bars too small.
        omitted = f"; {found.zeros:,} labels with 0 are not included" if found.zeros else ""
        chart = histogram(name, found.counts, found.edges, name)
        figures.append(Figure.of_chart(chart, f"{meaning}; {found.above:,} labels{omitted}"))
    return Section("Losses, priors and weights", figures=figures)


def by_category(totals: RoundTotals, categories: tuple[str, ...]) -> Section:
    """Return the section with a row per category and distance, and totals.

    Args:
        totals: see `RoundTotals`.
        categories: the categories to list first.
    """
    rows = []
    for category in dict.fromkeys((*categories, *(name for name, _ in totals.cells))):
        bands = {band: totals.cells.get((category, band)) for band in range(len(BANDS) - 1)}
        found = {band: sums for band, sums in bands.items() if sums is not None}
        if found:
            rows.append((category, ALL, *_cells(_together(list(found.values())))))
        rows += [(category, _place(band), *_cells(sums)) for band, sums in found.items()]
    rows.append((ALL, "", *_cells(totals.everything)))
    columns = (
        "category", "distance", "labels", "weight > 0", "share kept", "sum of weights",
        "mean weight", "mean score",
    )  # fmt: skip
    return Section("Labels by category and distance", columns=columns, rows=rows)


def beside_others(workspace: Workspace, number: int, policy: str) -> Iterator[Section]:
    """Yield the section that compares policies, if several have weighted the same labels."""
    postgresql = workspace.database.url.get_backend_name() == "postgresql"
    query = find_query("counts").filtered(None, number, postgresql=postgresql)
    totals: dict[str, np.ndarray] = {}
    with workspace.database.reading() as connection:
        for _, name, _, *counts in connection.execute(text(query)):
            totals[name] = totals.get(name, 0) + np.array(counts, dtype=np.float64)
    rows = [
        (
            f"{name} (this page)" if name == policy else name,
            *map(int, (labels, kept, trusted)),
            *(float(weight), float(weight / labels), int(human)),
        )
        for name, (labels, kept, trusted, weight, human) in sorted(totals.items())
    ]
    if len(rows) > 1:
        columns = (
            "policy", "labels", "weight > 0", "weight > 0.5", "sum of weights", "mean", "human",
        )  # fmt: skip
        note = (
            "The same labels with the weights of every policy that was run in this round; human: "
            "labels that people decided, alike under every policy."
        )
        yield Section("Comparison with other policies", note, columns, rows)


def _together(parts: list[Sums]) -> Sums:
    return Sums(
        sum(part.labels for part in parts),
        sum(part.kept for part in parts),
        sum(part.weight for part in parts),
        sum(part.score for part in parts),
    )


def _place(band: int) -> str:
    near, far = BANDS[band], BANDS[band + 1]
    return f"{near:.0f}-{far:.0f} m" if np.isfinite(far) else f"from {near:.0f} m"


def _cells(sums: Sums) -> tuple[int, int, float, float, float, float]:
    """Return the cells: labels, kept labels, their share, sum and means of weight and score."""
    n = sums.labels
    return n, sums.kept, sums.kept / n, sums.weight, sums.weight / n, sums.score / n


def _age(workspace: Workspace, number: int) -> str:
    """Return e/E: the round, and the number of rounds when it was made."""
    table = bulk.table("round")
    query = select(table.c.rounds).where(table.c.number == number)
    rows = workspace.database.rows(query)
    return f"{number}/{rows[0][0]}" if rows else str(number)
