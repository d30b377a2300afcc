"""Labels that held-out predictions, points or pixels contradict: suspects, the strangest first.

Every finding has the same scale. Its suspicion is the share of comparable cases in which the
opposite is true: 0.97 for a prediction without a label says that 97 % of the predictions with such
a score, so many points and pixels have one. Several findings about one label are combined as if
they were independent, 1 - product of (1 - suspicion). The result is a rank, not the probability
that the label is wrong.

The idea to rank labels by the confidence of models that were not trained on them is confident
learning (Northcutt et al., "Confident Learning: Estimating Uncertainty in Dataset Labels", JAIR
2021).
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from curate.detections import Annotations, Detections
from curate.evaluation.proposals import Proposals
from curate.evaluation.reliability import MatchSettings, match_to_ground_truth
from curate.geometry.overlap import bev_iou
from curate.geometry.similarity import wrap_angle
from curate.shapes import Bool, Float, Int, Shaped

Kind = Literal[
    "missing",
    "mask",
    "not found",
    "no points",
    "no pixels",
    "category",
    "position",
    "size",
    "heading",
]
KINDS: tuple[str, ...] = get_args(Kind)
"""missing and mask: a confident prediction, or an image mask with points, without a label. The
others are findings about a label."""

SAME_OBJECT_IOU = 0.1
"""Boxes with a greater BEV IoU are the same object, perhaps with a wrong box or category."""
NEAR_METRES = 3.0
"""A label without a prediction belongs to a prediction without a label within this distance."""
LEAST_SHARE = 0.05
"""A label with a smaller share of pixels of its category, S/A, has no pixels."""
LEAST_CONFIDENCE = 0.25
"""A label has been found if it overlaps a prediction with at least this confidence."""
_LEAST_PAIRS = 5
_PENALTY = 1.0


@dataclass(frozen=True)
class CheckedFrame:
    """The n labels of a frame, and the m predictions of a teacher not trained on it.

    Attributes:
        frame: name of the frame.
        truth: the labels, without regions that have no box.
        found: the predictions.
        truth_points: (n,) LiDAR points in each label.
        found_points: (m,) LiDAR points in each prediction.
        truth_share: (n,) share S/A of the label's rectangle with pixels of its category; NaN if no
            camera shows it, or nothing was segmented.
        found_share: (m,) the same for each prediction.
        counted: (m,) bool, False for predictions where labels cannot be expected: in a DontCare
            region, or outside all images if only objects in images are labeled.
        masks: objects proposed from image masks and points, whether they have a label or not.
    """

    frame: str
    truth: Annotations
    found: Detections
    truth_points: Int[np.ndarray, " n"]
    found_points: Int[np.ndarray, " m"]
    truth_share: Float[np.ndarray, " n"]
    found_share: Float[np.ndarray, " m"]
    counted: Bool[np.ndarray, " m"]
    masks: Proposals = field(default_factory=Proposals.empty)


@dataclass(frozen=True)
class Finding:
    """One contradiction.

    Attributes:
        kind: one of `KINDS`.
        suspicion: share of comparable cases in which the opposite is true, in [0, 1].
        reason: a sentence with the numbers.
    """

    kind: str
    suspicion: float
    reason: str


@dataclass(frozen=True)
class Suspect:
    """A label that may be wrong, or a place where a label may be missing.

    Attributes:
        frame: number of the frame in the sequence of checked frames.
        label: number of the label in its frame; -1 for a missing one.
        prediction: number of the prediction that contradicts it; -1 if none does.
        mask: number of the proposal from a mask that contradicts it; -1 if none does.
        category: category of the label, or of the prediction if the label is missing.
        suspicion: of all findings together, in [0, 1].
        findings: the most suspicious first; at least one.
    """

    frame: int
    label: int
    prediction: int
    category: str
    suspicion: float
    findings: tuple[Finding, ...]
    mask: int = -1

    @property
    def kind(self) -> str:
        """The kind of the most suspicious finding."""
        return self.findings[0].kind

    @property
    def reason(self) -> str:
        """The findings as text."""
        return "; ".join(finding.reason for finding in self.findings)


@dataclass(frozen=True)
class _Side:
    """Labels or predictions of all frames as columns: n rows.

    `hidden` has the occlusion level and the truncation of labels, which explain why an object has
    few points or pixels, or is not found; zeros for predictions.
    """

    frame: Int[np.ndarray, " n"]
    number: Int[np.ndarray, " n"]
    category: Shaped[np.ndarray, " n"]
    boxes: Float[np.ndarray, "n 7"]
    points: Int[np.ndarray, " n"]
    share: Float[np.ndarray, " n"]
    hidden: Float[np.ndarray, "n 2"]

    @property
    def distance(self) -> Float[np.ndarray, " n"]:
        """(n,) metres on the ground."""
        return np.asarray(np.hypot(self.boxes[:, 0], self.boxes[:, 1]))


def find_suspects(
    frames: Sequence[CheckedFrame], categories: Sequence[str], minimum: float = 0.7
) -> list[Suspect]:
    """Return the suspects of all frames, by falling suspicion.

    Args:
        frames: frames with labels and held-out predictions.
        categories: the categories to check. Labels of others only explain predictions.
        minimum: lowest suspicion to return.
    """
    labels, found = _side(frames, of_labels=True), _side(frames, of_labels=False)
    overlaps = _overlaps(frames)
    counted, matched = _matches(frames, categories)
    scores = np.concatenate([np.zeros(0), *(each.found.scores for each in frames)])
    confidence = _confidence(found, scores, matched >= 0, counted)
    checked = np.isin(labels.category, categories)
    by_label: dict[int, list[Finding]] = {int(i): [] for i in np.flatnonzero(checked)}
    partner: dict[int, int] = {}
    missing = _missing(found, scores, confidence, counted & ~overlaps.explained(len(scores)))
    support = overlaps.support(confidence, len(checked))
    for i, j, finding in (
        *_moved_away(labels, found, confidence, support, checked, missing),
        *_wrong_categories(labels, found, confidence, matched, overlaps, checked),
        *_wrong_boxes(labels, found, confidence, matched, checked),
    ):
        by_label[i].append(finding)
        partner.setdefault(i, j)
    for i, finding in (
        *_not_found(labels, support, checked, set(partner)),
        *_without(labels, checked, "points"),
        *_without(labels, checked, "pixels"),
        *_odd_sizes(labels, checked),
    ):
        by_label[i].append(finding)
    places = {j: i for i, j in partner.items()}  # of predictions that a wrong label explains
    by_prediction = {j: [each] for j, each in missing.items() if j not in places}
    alone = []
    for mask, finding, j in _unlabeled_masks(frames, missing):
        if j in places:
            by_label[places[j]].append(finding)
        elif j in by_prediction:
            by_prediction[j].append(finding)
        else:
            alone.append((mask, finding))
    suspects = [
        *(
            _suspect(labels, i, findings, int(found.number[partner[i]]) if i in partner else -1)
            for i, findings in by_label.items()
            if findings
        ),
        *(
            replace(_suspect(found, j, findings, int(found.number[j])), label=-1)
            for j, findings in by_prediction.items()
        ),
        *(
            Suspect(
                frame, -1, -1, str(frames[frame].masks.categories[n]), each.suspicion, (each,), n
            )
            for (frame, n), each in alone
        ),
    ]
    kept = (each for each in suspects if each.suspicion >= minimum)
    return sorted(kept, key=_rank)


def _rank(suspect: Suspect) -> tuple[float, ...]:
    return -suspect.suspicion, suspect.frame, suspect.label, suspect.prediction, suspect.mask


def combined(suspicions: Sequence[float]) -> float:
    """Return the suspicion of several findings about one label, as if they were independent."""
    return 1.0 - float(np.prod([1 - each for each in suspicions]))


def share_of_clearly_smaller(
    deviations: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Return (n,) the share of all deviations that are less than a quarter of each one.

    The largest of a few hundred normal deviations is not suspicious: many are more than a quarter
    of it. The share is of n + 1, so that it says little if there are few.
    """
    ordered = np.sort(deviations)
    smaller = np.searchsorted(ordered, deviations / 4, side="left")
    return np.asarray(smaller / (len(deviations) + 1.0))


def fit_shares(
    features: Float[np.ndarray, "n f"], outcome: Bool[np.ndarray, " n"], steps: int = 30
) -> Float[np.ndarray, " n"]:
    """Return (n,) the fitted probability of an outcome, by ridge logistic regression.

    Newton's method on standardised features, with a penalty of 1/2 per squared coefficient (none on
    the intercept). Without rows of both outcomes the result is their share, (k + 1) / (n + 2).
    """
    n = len(outcome)
    if n == 0 or outcome.all() or not outcome.any():
        return np.full(n, (outcome.sum() + 1.0) / (n + 2.0))
    spread = features.std(axis=0)
    scaled = (features - features.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    x = np.column_stack([np.ones(n), scaled])
    penalty = np.diag([1e-6, *np.full(scaled.shape[1], _PENALTY)])
    w = np.zeros(x.shape[1])
    for _ in range(steps):
        p = _sigmoid(x @ w)
        gradient = x.T @ (p - outcome) + penalty @ w
        step = np.linalg.solve((x.T * (p * (1 - p))) @ x + penalty, gradient)
        # A full step can overshoot where nearly all p are 0 or 1.
        w -= step * min(1.0, 5.0 / max(float(np.abs(step).max()), 1e-12))
        if np.abs(step).max() < 1e-8:
            break
    return _sigmoid(x @ w)


@dataclass(frozen=True)
class _Overlaps:
    """Pairs of label and prediction with a BEV IoU above `SAME_OBJECT_IOU`, by row."""

    label: Int[np.ndarray, " p"]
    prediction: Int[np.ndarray, " p"]

    def explained(self, predictions: int) -> Bool[np.ndarray, " m"]:
        """Return (m,) bool, True for predictions that overlap a label of any category."""
        return np.bincount(self.prediction, minlength=predictions).astype(bool)

    def support(self, confidence: np.ndarray, labels: int) -> Float[np.ndarray, " n"]:
        """Return (n,) the greatest confidence of a prediction of any category over each label."""
        greatest = np.zeros(labels)
        np.maximum.at(greatest, self.label, confidence[self.prediction])
        return greatest


def _side(frames: Sequence[CheckedFrame], *, of_labels: bool) -> _Side:
    parts = [
        (each.truth, each.truth_points, each.truth_share, _hidden(each.truth))
        if of_labels
        else (each.found, each.found_points, each.found_share, np.zeros((len(each.found), 2)))
        for each in frames
    ]
    sizes = [len(objects) for objects, *_ in parts]
    return _Side(
        np.repeat(np.arange(len(frames)), sizes),
        np.concatenate([np.zeros(0, np.int64), *(np.arange(size) for size in sizes)]),
        np.concatenate([np.zeros(0, np.str_), *(each.categories for each, *_ in parts)]),
        np.concatenate([np.zeros((0, 7)), *(each.boxes for each, *_ in parts)]),
        np.concatenate([np.zeros(0, np.int64), *(points for _, points, *_ in parts)]),
        np.concatenate([np.zeros(0), *(share for _, _, share, _ in parts)]),
        np.concatenate([np.zeros((0, 2)), *(hidden for *_, hidden in parts)]),
    )


def _hidden(truth: Annotations) -> np.ndarray:
    """Return (n, 2) occlusion level and truncation; 0 where a data set does not know them."""
    known = np.stack([truth.occluded.astype(np.float64), truth.truncated], axis=1)
    return np.asarray(np.clip(np.nan_to_num(known), 0, [3, 1]))


def _overlaps(frames: Sequence[CheckedFrame]) -> _Overlaps:
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    first_label = first_prediction = 0
    for each in frames:
        same = np.argwhere(bev_iou(each.truth.boxes, each.found.boxes) > SAME_OBJECT_IOU)
        pairs.append(same + np.array([first_label, first_prediction]))
        first_label += len(each.truth)
        first_prediction += len(each.found)
    return _Overlaps(*np.concatenate(pairs).T)


def _matches(
    frames: Sequence[CheckedFrame], categories: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return (m,) whether each prediction counts, and (m,) the row of its label, -1 for none."""
    settings = MatchSettings(minimum_iou=dict.fromkeys(categories, SAME_OBJECT_IOU))
    counted, matched, first = [np.zeros(0, dtype=bool)], [np.zeros(0, dtype=np.int64)], 0
    for each in frames:
        found = match_to_ground_truth(each.found, each.truth, settings)
        counted.append(each.counted & found.counted)
        matched.append(np.where(found.matched >= 0, found.matched + first, -1))
        first += len(each.truth)
    return np.concatenate(counted), np.concatenate(matched)


def _confidence(
    found: _Side, scores: np.ndarray, has_label: np.ndarray, counted: np.ndarray
) -> np.ndarray:
    """Return (m,) the share of predictions like each one that have a label; 0 if not counted."""
    clipped = np.clip(scores, 1e-4, 1 - 1e-4)
    columns = [
        np.log(clipped / (1 - clipped)), np.log1p(found.points), _filled(found.share),
        _context(found),
    ]  # fmt: skip
    confidence = np.zeros(len(scores))
    rows = np.flatnonzero(counted)
    confidence[rows] = fit_shares(np.column_stack(columns)[rows], has_label[rows])
    return confidence


def _context(side: _Side) -> np.ndarray:
    """Return (n, f) distance, category, occlusion and truncation as features."""
    names = np.unique(side.category)[1:]
    is_name = (1.0 * (side.category == name) for name in names)
    return np.column_stack([side.distance / 10, *is_name, side.hidden])


def _filled(share: np.ndarray) -> np.ndarray:
    """Return shares with the mean in place of unknown ones; zeros if all are unknown."""
    known = ~np.isnan(share)
    return np.where(known, share, share[known].mean() if known.any() else 0.0)


def _missing(
    found: _Side, scores: np.ndarray, confidence: np.ndarray, unexplained: np.ndarray
) -> dict[int, Finding]:
    """Return the findings about predictions without a label, by row."""
    findings = {}
    for j in np.flatnonzero(unexplained).tolist():
        p = float(confidence[j])
        reason = (
            f"no label here, but a {found.category[j]} is predicted with score {scores[j]:.2f}, "
            f"{_evidence(found, j)}; {p:.0%} of such predictions have a label"
        )
        findings[j] = Finding("missing", p, reason)
    return findings


def _unlabeled_masks(
    frames: Sequence[CheckedFrame], missing: Mapping[int, Finding]
) -> Iterator[tuple[tuple[int, int], Finding, int]]:
    """Yield the masks without a label: frame and number, the finding, and a prediction there.

    The prediction is the row of one that has no label either, -1 for none.
    """
    frame = np.repeat(np.arange(len(frames)), [len(each.masks) for each in frames])
    if not len(frame):
        return
    number = np.concatenate([np.arange(len(each.masks)) for each in frames])
    boxes = np.concatenate([each.masks.boxes for each in frames])
    names = np.concatenate([each.masks.categories for each in frames])
    points = np.concatenate([each.masks.points for each in frames])
    pixels = np.concatenate([each.masks.pixels for each in frames])
    has_label = np.concatenate([
        (bev_iou(each.masks.boxes, each.truth.boxes) > SAME_OBJECT_IOU).any(axis=1)
        for each in frames
    ])  # fmt: skip
    is_name = [1.0 * (names == name) for name in np.unique(names)[1:]]
    distance = np.hypot(boxes[:, 0], boxes[:, 1])
    features = np.column_stack([np.log1p(points), np.log1p(pixels), distance / 10, *is_name])
    shares = fit_shares(features, has_label)
    starts = np.cumsum([0, *(len(each.found) for each in frames)])
    for row in np.flatnonzero(~has_label).tolist():
        found = frames[frame[row]].found
        overlaps = bev_iou(boxes[row : row + 1], found.boxes)[0] > SAME_OBJECT_IOU
        rows = [j for j in (starts[frame[row]] + np.flatnonzero(overlaps)).tolist() if j in missing]
        share = float(shares[row])
        reason = (
            f"an image mask of a {names[row]} has {pixels[row]} pixels and {points[row]} points, "
            f"but no label; {share:.0%} of such masks have one"
        )
        best = max(rows, key=lambda j: missing[j].suspicion, default=-1)
        yield (int(frame[row]), int(number[row])), Finding("mask", share, reason), best


def _moved_away(
    labels: _Side,
    found: _Side,
    confidence: np.ndarray,
    support: np.ndarray,
    checked: np.ndarray,
    missing: Mapping[int, Finding],
) -> Iterator[tuple[int, int, Finding]]:
    """Yield labels that no prediction supports, each with the nearest prediction without a label.

    Nearest pairs come first, and a prediction belongs to one label.
    """
    free = np.array([j for j in missing if confidence[j] >= LEAST_CONFIDENCE], dtype=np.int64)
    alone = np.flatnonzero(checked & (support < LEAST_CONFIDENCE))
    between = np.linalg.norm(labels.boxes[alone, None, :2] - found.boxes[None, free, :2], axis=2)
    possible = (labels.frame[alone, None] == found.frame[None, free]) & (
        labels.category[alone, None] == found.category[None, free]
    )
    rows, columns = np.nonzero(possible & (between <= NEAR_METRES))
    taken_labels, taken_predictions = set(), set()
    for at in np.argsort(between[rows, columns], kind="stable").tolist():
        i, j = int(alone[rows[at]]), int(free[columns[at]])
        if i in taken_labels or j in taken_predictions:
            continue
        taken_labels.add(i)
        taken_predictions.add(j)
        p = float(confidence[j])
        reason = (
            f"the {labels.category[i]} is predicted {between[rows[at], columns[at]]:.1f} m away "
            f"with {p:.0%} confidence ({_evidence(found, j)}; {_evidence(labels, i)} in the label)"
        )
        yield i, j, Finding("position", p, reason)


def _wrong_categories(
    labels: _Side,
    found: _Side,
    confidence: np.ndarray,
    matched: np.ndarray,
    overlaps: _Overlaps,
    checked: np.ndarray,
) -> Iterator[tuple[int, int, Finding]]:
    """Yield labels over which another category is predicted with more confidence than their own."""
    own = np.zeros(len(checked))
    of_pair = matched >= 0
    np.maximum.at(own, matched[of_pair], confidence[of_pair])
    other = checked[overlaps.label] & (matched[overlaps.prediction] < 0)
    other &= labels.category[overlaps.label] != found.category[overlaps.prediction]
    pairs = np.stack([overlaps.label, overlaps.prediction], axis=1)[other]
    ordered = pairs[np.argsort(confidence[pairs[:, 1]], kind="stable")]
    best = dict(ordered.tolist())  # of each label, the last and most confident one
    for i, j in best.items():
        p = float(confidence[j] * (1 - own[i]))
        reason = (
            f"labeled {labels.category[i]}, predicted {found.category[j]} with "
            f"{confidence[j]:.0%} confidence, and {labels.category[i]} with {own[i]:.0%}"
        )
        yield i, j, Finding("category", p, reason)


def _wrong_boxes(
    labels: _Side, found: _Side, confidence: np.ndarray, matched: np.ndarray, checked: np.ndarray
) -> Iterator[tuple[int, int, Finding]]:
    """Yield labels with a box that differs more from its prediction than others do."""
    j = np.flatnonzero(matched >= 0)
    j = j[checked[matched[j]]]
    i = matched[j]
    ours, theirs = labels.boxes[i], found.boxes[j]
    deviations = {
        "position": (np.linalg.norm(ours[:, :2] - theirs[:, :2], axis=1), "m from it", 1.0),
        "size": (_size_deviation(ours, theirs), "% from it in size", 100.0),
        "heading": (np.abs(wrap_angle(ours[:, 6] - theirs[:, 6])), "degrees from it", 180 / np.pi),
    }
    for category in np.unique(labels.category[i]):
        rows = np.flatnonzero(labels.category[i] == category)
        if len(rows) < _LEAST_PAIRS:
            continue
        shares = {
            kind: share_of_clearly_smaller(deviation[rows])
            for kind, (deviation, _, _) in deviations.items()
        }
        for place, row in enumerate(rows.tolist()):
            # The three are of one comparison, so only the most striking one counts.
            kind = max(shares, key=lambda each: shares[each][place])
            deviation, unit, scale = deviations[kind]
            p, share = float(confidence[j[row]]), float(shares[kind][place])
            reason = (
                f"predicted with {p:.0%} confidence, and {scale * deviation[row]:.3g} {unit}; "
                f"{share:.0%} of {category} labels differ by less than a quarter as much"
            )
            yield int(i[row]), int(j[row]), Finding(kind, share * p, reason)


def _odd_sizes(labels: _Side, checked: np.ndarray) -> Iterator[tuple[int, Finding]]:
    """Yield labels with a size that differs from those of their category."""
    for category in np.unique(labels.category[checked]):
        rows = np.flatnonzero(checked & (labels.category == category))
        boxes = labels.boxes[rows]
        if len(rows) < _LEAST_PAIRS or not (boxes[:, 3:6] > 0).all():
            continue
        middle = np.exp(np.median(np.log(boxes[:, 3:6]), axis=0))
        typical = np.concatenate([np.zeros(3), middle, np.zeros(1)])[None]
        deviation = _size_deviation(boxes, np.repeat(typical, len(rows), axis=0))
        shares = share_of_clearly_smaller(deviation)
        for row, share, box in zip(rows.tolist(), shares.tolist(), boxes, strict=True):
            size, usual = (
                " x ".join(f"{side:.1f}" for side in each) for each in (box[3:6], middle)
            )
            reason = (
                f"{size} m, a {category} usually has {usual}; {share:.0%} of {category} labels "
                "differ by less than a quarter as much"
            )
            yield row, Finding("size", share, reason)


def _not_found(
    labels: _Side, support: np.ndarray, checked: np.ndarray, explained: Collection[int]
) -> Iterator[tuple[int, Finding]]:
    """Yield labels without a prediction, by how many like them have one.

    Those with a finding about a prediction, such as one some metres away, are left out.
    """
    rows = np.flatnonzero(checked)
    is_found = support[rows] >= LEAST_CONFIDENCE
    features = np.column_stack([np.log1p(labels.points), _context(labels)])[rows]
    shares = fit_shares(features, is_found)
    for row, share in zip(rows[~is_found].tolist(), shares[~is_found].tolist(), strict=True):
        if row in explained:
            continue
        reason = (
            f"not predicted, with {_evidence(labels, row)} at {labels.distance[row]:.0f} m; "
            f"{share:.0%} of such labels are"
        )
        yield row, Finding("not found", float(share), reason)


def _without(
    labels: _Side, checked: np.ndarray, what: Literal["points", "pixels"]
) -> Iterator[tuple[int, Finding]]:
    """Yield labels without points or pixels, by how many like them have some."""
    known = checked & (~np.isnan(labels.share) if what == "pixels" else True)
    some = labels.points > 0 if what == "points" else labels.share >= LEAST_SHARE
    rows = np.flatnonzero(known)
    features = _context(labels)
    if what == "pixels":
        features = np.column_stack([np.log1p(labels.points), features])
    shares = fit_shares(features[rows], some[rows])
    for row, share in zip(rows.tolist(), shares.tolist(), strict=True):
        if some[row]:
            continue
        category = labels.category[row]
        here = (
            "no LiDAR point lies in the label"
            if what == "points"
            else f"{labels.share[row]:.0%} of its image area shows a {category}"
        )
        yield row, Finding(f"no {what}", share, f"{here}; {share:.0%} of such labels have more")


def _size_deviation(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return (n,) the sum over the sides of |ln(side / other side)|; 0 for invalid sides."""
    sides, other = boxes[:, 3:6], others[:, 3:6]
    valid = (sides > 0) & (other > 0)
    ratio = np.log(np.where(valid, sides, 1.0) / np.where(valid, other, 1.0))
    return np.asarray(np.abs(ratio).sum(axis=1))


def _evidence(side: _Side, row: int) -> str:
    points = int(side.points[row])
    text = f"{points} {'point' if points == 1 else 'points'}"
    share = side.share[row]
    return text if np.isnan(share) else f"{text} and {share:.0%} of its image area"


def _suspect(side: _Side, row: int, findings: Sequence[Finding], prediction: int) -> Suspect:
    """Return the suspect; findings that hardly matter are left out of its reasons."""
    ordered = sorted(findings, key=lambda each: -each.suspicion)
    listed = [each for each in ordered if each.suspicion >= 0.5] or ordered[:1]
    return Suspect(
        int(side.frame[row]),
        int(side.number[row]),
        prediction,
        str(side.category[row]),
        combined([each.suspicion for each in listed]),
        tuple(listed),
    )


def _sigmoid(z: np.ndarray) -> np.ndarray:
    return np.asarray(1 / (1 + np.exp(-np.clip(z, -60, 60))))
