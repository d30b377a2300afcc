"""Suspects among labels, on scenes made by hand."""

from dataclasses import replace

import numpy as np
import pytest

from curate.detections import Annotations, Detections, as_categories
from curate.evaluation.proposals import Proposals
from curate.evaluation.suspects import (
    CheckedFrame,
    Suspect,
    combined,
    find_suspects,
    fit_shares,
    share_of_clearly_smaller,
)

CAR, WALKER = (4.0, 1.8, 1.5), (0.8, 0.6, 1.8)


def annotations(boxes: np.ndarray, names: list[str]) -> Annotations:
    """Return labels with these boxes."""
    n = len(names)
    return Annotations(
        boxes, as_categories(names), np.zeros(n), np.zeros(n, np.int64), np.zeros(n),
        np.zeros((n, 4)),
    )  # fmt: skip


def scene(seed: int, score: float = 0.9) -> CheckedFrame:
    """Return four cars and four pedestrians, well predicted, and two weak predictions of nothing.

    Every label has 40 points and 80 % of its pixels; the predictions of nothing 2 points, none.
    """
    generator = np.random.default_rng(seed)
    names = ["Car"] * 4 + ["Pedestrian"] * 4
    places = np.column_stack([np.arange(10, 50, 5), generator.uniform(-8, 8, 8), np.full(8, -1.0)])
    sizes = np.array([CAR] * 4 + [WALKER] * 4)
    boxes = np.column_stack([places, sizes, generator.uniform(-3, 3, 8)])
    noise = generator.normal(0, 0.05, boxes.shape) * [1, 1, 0, 0.2, 0.2, 0.2, 1]
    nothing = np.array([[20, 25, -1, *CAR, 0], [30, -25, -1, *WALKER, 0]])
    found = Detections(
        np.concatenate([boxes + noise, nothing]),
        np.array([score] * 8 + [0.2, 0.2]),
        as_categories([*names, "Car", "Pedestrian"]),
    )
    return CheckedFrame(
        f"{seed:06d}", annotations(boxes, names), found,
        np.full(8, 40), np.array([40] * 8 + [2, 2]),
        np.full(8, 0.8), np.array([0.8] * 8 + [0.0, 0.0]), np.full(10, True),
    )  # fmt: skip


def scenes(changed: CheckedFrame) -> list[CheckedFrame]:
    """Return a frame with an error before eleven frames without errors."""
    return [changed, *map(scene, range(1, 12))]


def suspects(changed: CheckedFrame, **options: float) -> list[Suspect]:
    """Return the suspects among twelve scenes, the first of which has an error."""
    return find_suspects(scenes(changed), ("Car", "Pedestrian"), **options)


def with_label(frame: CheckedFrame, index: int, **changes: object) -> CheckedFrame:
    """Return the frame with another box or category of a label."""
    boxes, names = frame.truth.boxes.copy(), frame.truth.categories.copy()
    if "move" in changes:
        boxes[index, :2] += changes["move"]
    if "scale" in changes:
        boxes[index, 3:6] *= changes["scale"]
    if "turn" in changes:
        boxes[index, 6] += changes["turn"]
    names[index] = changes.get("category", names[index])
    return replace(frame, truth=replace(frame.truth, boxes=boxes, categories=names))


def without_label(frame: CheckedFrame, index: int) -> CheckedFrame:
    """Return the frame without a label."""
    kept = np.arange(len(frame.truth)) != index
    return replace(
        frame, truth=frame.truth.select(kept), truth_points=frame.truth_points[kept],
        truth_share=frame.truth_share[kept],
    )  # fmt: skip


def test_labels_that_everything_confirms_are_not_suspicious() -> None:
    """Neither are weak predictions of nothing: hardly any of them has a label."""
    assert suspects(scene(0)) == []


def test_a_confident_prediction_without_a_label_is_suspicious() -> None:
    """The only suspect, with its numbers in words."""
    [suspect] = suspects(without_label(scene(0), 2))
    assert (suspect.frame, suspect.label, suspect.prediction) == (0, -1, 2)
    assert (suspect.kind, suspect.category) == ("missing", "Car")
    assert suspect.suspicion > 0.9
    assert "score 0.90, 40 points and 80% of its image area" in suspect.reason


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"category": "Pedestrian"}, "category"),
        ({"move": (2.4, 1.0)}, "position"),
        ({"move": (0.9, 0.4)}, "position"),
        ({"scale": 1.4}, "size"),
        ({"turn": 0.9}, "heading"),
        ({"turn": np.pi}, "heading"),
    ],
)
def test_a_wrong_label_is_the_first_suspect(changes: dict, kind: str) -> None:
    """One suspect per error, of the right kind, although its place is predicted as well."""
    first, *others = suspects(with_label(scene(0), 1, **changes), minimum=0.8)
    assert (first.frame, first.label, first.prediction) == (0, 1, 1)
    assert kind in {finding.kind for finding in first.findings if finding.suspicion > 0.8}
    assert others == []


@pytest.mark.parametrize(
    ("points", "share", "kind"), [(0, 0.8, "no points"), (40, 0.0, "no pixels")]
)
def test_labels_without_points_pixels_or_predictions_are_suspicious(
    points: int, share: float, kind: str
) -> None:
    """The suspicion of several findings is combined."""
    frame = with_label(scene(0), 1, move=(0.0, 40.0))
    frame.truth_points[1], frame.truth_share[1] = points, share
    [missing, label] = sorted(suspects(frame), key=lambda each: each.label)
    assert (missing.label, missing.prediction, label.label) == (-1, 1, 1)
    kinds = {finding.kind: finding.suspicion for finding in label.findings}
    assert kinds[kind] > 0.9
    assert label.suspicion == pytest.approx(combined(list(kinds.values())))


def test_hidden_labels_are_less_suspicious() -> None:
    """If labels of occluded objects often have no pixels, one more is no surprise."""
    frames = scenes(scene(0))
    for frame in frames[:6]:
        frame.truth.occluded[0], frame.truth_share[0] = 2, 0.0
    frames[-1].truth_share[0] = 0.0
    [suspect] = find_suspects(frames, ("Car", "Pedestrian"))
    assert (suspect.frame, suspect.kind) == (11, "no pixels")


def with_masks(frame: CheckedFrame, boxes: np.ndarray) -> CheckedFrame:
    """Return the frame with a large mask of a car at each box."""
    n = len(boxes)
    names, counts = as_categories(["Car"] * n), np.full(n, 50)
    return replace(frame, masks=Proposals(boxes, names, counts, counts, as_categories([""] * n)))


def test_masks_without_a_label_are_suspicious() -> None:
    """Alone, with a prediction that has no label, and not where there is a label."""
    truth = [scene(seed).truth.boxes[:4] for seed in range(12)]
    masked = [with_masks(frame, truth[n]) for n, frame in enumerate(scenes(scene(0)))]
    assert find_suspects(masked, ("Car", "Pedestrian")) == []
    elsewhere = truth[0][:1] + np.array([0, 14, 0, 0, 0, 0, 0])
    masked[0] = with_masks(scene(0), np.concatenate([truth[0], elsewhere]))
    [alone] = find_suspects(masked, ("Car", "Pedestrian"))
    assert (alone.frame, alone.label, alone.prediction, alone.mask) == (0, -1, -1, 4)
    assert "50 pixels and 50 points, but no label" in alone.reason
    masked[0] = with_masks(without_label(scene(0), 2), truth[0])
    [both] = find_suspects(masked, ("Car", "Pedestrian"))
    assert (both.label, both.prediction) == (-1, 2)
    assert {finding.kind for finding in both.findings} == {"missing", "mask"}
    assert both.suspicion > max(finding.suspicion for finding in both.findings)


def test_predictions_that_do_not_count_are_not_missing_labels() -> None:
    """As in DontCare regions."""
    frame = without_label(scene(0), 2)
    assert suspects(replace(frame, counted=np.arange(10) != 2)) == []


def test_labels_of_other_categories_are_not_checked_but_explain_predictions() -> None:
    """A van is predicted as a car: neither a wrong label nor a missing one."""
    assert suspects(with_label(scene(0), 1, category="Van")) == []


def test_without_segmentation_and_without_predictions() -> None:
    """Unknown pixels are no finding; a detector that found nothing contradicts nothing."""
    frames = [
        replace(each, truth_share=np.full(len(each.truth), np.nan), found_share=np.full(10, np.nan))
        for each in scenes(without_label(scene(0), 2))
    ]
    [suspect] = find_suspects(frames, ("Car", "Pedestrian"))
    assert "pixels" not in suspect.reason
    blind = [
        replace(each, found=Detections.empty(), found_points=np.zeros(0, np.int64),
                found_share=np.zeros(0), counted=np.zeros(0, dtype=bool))
        for each in scenes(scene(0))
    ]  # fmt: skip
    assert find_suspects(blind, ("Car", "Pedestrian")) == []
    assert find_suspects([], ("Car",)) == []


def test_the_share_of_clearly_smaller_deviations() -> None:
    """By hand: of 1, 2, 5 and 10, a quarter of 10 is above two of them, one of 5 above one."""
    assert share_of_clearly_smaller(np.array([1.0, 10, 5, 2])).tolist() == [0, 2 / 5, 1 / 5, 0]


def test_the_suspicion_of_independent_findings() -> None:
    """1 - 0.5 * 0.2."""
    assert combined([0.5, 0.8]) == pytest.approx(0.9)


def test_the_fit_is_the_optimum_of_its_objective() -> None:
    """Against gradient descent with small steps."""
    generator = np.random.default_rng(0)
    features = generator.normal(size=(200, 3)) * [1, 5, 0.1]
    outcome = generator.random(200) < 1 / (1 + np.exp(-features @ [1, 0.2, 0]))
    x = np.column_stack([np.ones(200), (features - features.mean(0)) / features.std(0)])
    w = np.zeros(4)
    for _ in range(5000):
        p = 1 / (1 + np.exp(-x @ w))
        w -= 0.01 * (x.T @ (p - outcome) + np.array([0, 1, 1, 1]) * w)
    expected = 1 / (1 + np.exp(-x @ w))
    assert fit_shares(features, outcome) == pytest.approx(expected, abs=1e-4)


def test_the_fit_without_one_of_the_outcomes_and_of_separable_data() -> None:
    """The first is the share with one more of each; the second stays finite."""
    assert fit_shares(np.zeros((3, 1)), np.full(3, True)) == pytest.approx([4 / 5] * 3)
    assert fit_shares(np.zeros((0, 1)), np.zeros(0, dtype=bool)).size == 0
    separable = fit_shares(np.arange(20.0)[:, None], np.arange(20) >= 10)
    assert np.isfinite(separable).all()
    assert separable[0] < 0.2
    assert separable[-1] > 0.8
