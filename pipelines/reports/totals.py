"""Totals, histograms and rankings of the labels of a round, computed block by block."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from sqlalchemy import func, select

from curate.priors.points import PointPrior
from curate.priors.semantic import SemanticPrior
from db import bulk
from db.evidence import read_declarations, weighted_label_columns
from pipelines.labels.columns import LabelColumns
from pipelines.workspace.workspace import Workspace

BANDS = (0.0, 20.0, 40.0, 60.0, np.inf)
"""Edges of the ranges of distance from the LiDAR, in metres."""
SHOWN_AGES = 4
LOSS_BINS, SHARE_BINS = 40, 25


@dataclass
class Histogram:
    """A histogram of values above 0, or of values from 0.

    Attributes:
        edges: (bins + 1,) edges of the bins, ascending; values above the last are not counted.
        counts: (bins,) number of values in each bin.
        above: number of values above 0.
        zeros: number of values that are 0; the remaining values are NaN.
        with_zeros: whether the bins include zeros.
    """

    edges: np.ndarray
    counts: np.ndarray = field(init=False)
    above: int = 0
    zeros: int = 0
    with_zeros: bool = False

    def __post_init__(self) -> None:
        self.counts = np.zeros(len(self.edges) - 1, dtype=np.int64)

    def add(self, values: np.ndarray) -> None:
        """Add (n,) values."""
        above, zeros = values > 0, values == 0
        counted = above | zeros if self.with_zeros else above
        self.counts += np.histogram(values[counted], self.edges)[0]
        self.above += int(above.sum())
        self.zeros += int(zeros.sum())


@dataclass
class Sums:
    """Sums over labels: their number, the number with a weight above 0, weights and scores."""

    labels: int = 0
    kept: int = 0
    weight: float = 0.0
    score: float = 0.0

    def add(self, weights: np.ndarray, scores: np.ndarray) -> None:
        """Add n labels with these (n,) weights and scores."""
        self.labels += len(weights)
        self.kept += int((weights > 0).sum())
        self.weight += float(weights.sum())
        self.score += float(scores.sum())


@dataclass
class RoundTotals:
    """Sums over the labels of a round.

    Attributes:
        extent: the greatest loss and the least lambda; NaN if there is none.
        shares: the columns with values from 0 to 1, with their meanings; each has a histogram.
        frames: number of frames with labels.
        trusted: number of labels with a weight above 0.5.
        unseen: number of labels without image evidence, because no camera shows them; None if the
            round has no image evidence.
        heaviest: the highest weight of a label without and with image evidence.
        ages: the `SHOWN_AGES` smallest values of lambda, and the greatest.
        everything: sums over all labels.
        cells: sums by category and index in `BANDS`.
        histograms: histograms of the loss and of each column in `shares`, by name.
    """

    extent: tuple[float, float]
    shares: Mapping[str, str]
    frames: int = 0
    trusted: int = 0
    unseen: int | None = None
    heaviest: tuple[float, float] = (0.0, 0.0)
    ages: np.ndarray = field(default_factory=lambda: np.zeros(0))
    everything: Sums = field(default_factory=Sums)
    cells: dict[tuple[str, int], Sums] = field(default_factory=dict)
    histograms: dict[str, Histogram] = field(init=False)

    def __post_init__(self) -> None:
        reach = float(np.nanmax((*self.extent, 1e-9))) * 1.02
        loss = Histogram(np.linspace(0, reach, LOSS_BINS + 1), with_zeros=True)
        edges = np.linspace(0, 1, SHARE_BINS + 1)
        self.histograms = {"loss": loss} | {name: Histogram(edges) for name in self.shares}

    @property
    def matched(self) -> int:
        """The number of labels with a loss."""
        loss = self.histograms["loss"]
        return loss.above + loss.zeros

    def add(self, labels: LabelColumns) -> None:
        """Add the labels of a block of frames."""
        weights, scores = labels.weights, labels.numbers["score"]
        self.frames += len(labels.frame_names)
        self.trusted += int((weights > 0.5).sum())
        self.everything.add(weights, scores)
        self._add_unseen(weights, labels.numbers["box_pixels"])
        ages = labels.numbers["lambda_u"]
        ages = np.unique([*self.ages, *np.unique(ages[~np.isnan(ages)])])
        self.ages = np.unique([*ages[:SHOWN_AGES], *ages[-1:]])
        for name, histogram in self.histograms.items():
            histogram.add(labels.numbers[name])
        distance = np.hypot(labels.boxes[:, 0], labels.boxes[:, 1])
        cell = labels.categories * len(BANDS) + np.digitize(distance, BANDS[1:])
        for number in np.unique(cell).tolist():
            category, band = divmod(number, len(BANDS))
            in_cell = cell == number
            sums = self.cells.setdefault((labels.category_names[category], band), Sums())
            sums.add(weights[in_cell], scores[in_cell])

    def _add_unseen(self, weights: np.ndarray, box_pixels: np.ndarray) -> None:
        """Count the labels without image evidence."""
        if np.isnan(box_pixels).all():
            return
        unseen = box_pixels == 0
        self.unseen = (self.unseen or 0) + int(unseen.sum())
        without, with_images = self.heaviest
        self.heaviest = (
            weights.max(where=unseen, initial=without),
            weights.max(where=box_pixels > 0, initial=with_images),
        )


def read_shares(workspace: Workspace) -> dict[str, str]:
    """Return the columns with values from 0 to 1, and their meanings.

    These are the weight, the score, the trust of every prior with stored evidence, and the product
    of the trusts.
    """
    with workspace.database.reading() as connection:
        columns = {each.name: each.meaning for each in weighted_label_columns(connection)}
        further = [each.rho_column for each in read_declarations(connection)]
    priors = (PointPrior.rho_column, SemanticPrior.rho_column, *further)
    names = ("weight", "score", *(name for name in priors if name is not None), "rho_det")
    return {name: columns[name] for name in names}


def extent(workspace: Workspace, round_number: int, policy: str) -> tuple[float, float]:
    """Return the greatest loss and the least lambda of a round; NaN if there is none."""
    loss, weight = bulk.table("consistency").c, bulk.table("weight").c
    queries = (
        select(func.max(loss.loss)).where(loss.round == round_number),
        select(func.min(weight.lambda_u)).where(
            weight.round == round_number, weight.policy == policy
        ),
    )
    with workspace.database.reading() as connection:
        found = [connection.execute(query).scalar_one() for query in queries]
    greatest, least = (float("nan") if each is None else float(each) for each in found)
    return greatest, least


@dataclass(frozen=True)
class RankedLabel:
    """A label and its rank.

    Attributes:
        rank: rank above 0; higher is first.
        frame: its frame.
        k: its k in the frame.
        category: its category.
        box: (7,) in the LiDAR frame.
        numbers: numeric columns of `weighted_labels` by name; NaN for null.
    """

    rank: float
    frame: str
    k: int
    category: str
    box: np.ndarray
    numbers: dict[str, float]


@dataclass
class Ranking:
    """The labels with the highest rank above 0 so far.

    Attributes:
        count: number of labels to keep.
        labels: the labels, highest rank first; labels of equal rank in the order of their arrival.
    """

    count: int
    labels: list[RankedLabel] = field(default_factory=list)

    def add(self, labels: LabelColumns, rank: np.ndarray) -> None:
        """Add a block of labels with their (n,) ranks."""
        first = np.argsort(-rank, kind="stable")[: self.count]
        found = [
            RankedLabel(
                float(rank[i]),
                labels.frame_names[labels.frames[i]],
                int(labels.k[i]),
                labels.category_names[labels.categories[i]],
                labels.boxes[i].copy(),
                {name: float(values[i]) for name, values in labels.numbers.items()},
            )
            for i in first[rank[first] > 0].tolist()
        ]
        self.labels = sorted([*self.labels, *found], key=lambda each: -each.rank)[: self.count]
