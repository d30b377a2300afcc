"""The whole chain from recorded detections to evaluated weights, on real frames of KITTI."""

from dataclasses import dataclass

import numpy as np
import pytest

from curate.consistency import consistency
from curate.datasets.kitti.dataset import KittiDataset
from curate.detections import Detections
from curate.detectors.recorded import RecordedDetector
from curate.evaluation.reliability import (
    MatchSettings,
    auroc,
    match_to_ground_truth,
    weighted_precision,
)
from curate.priors.points import PointPrior, learn_thresholds
from curate.priors.semantic import SemanticPrior
from curate.segmenters.classes import class_map
from curate.segmenters.onnx import OnnxSegmenter
from curate.weighting.base import Age, Evidence
from curate.weighting.self_paced import PSPSL, SPSL

pytestmark = pytest.mark.kitti

AGES = [Age(1, 10), Age(5, 10), Age(10, 10)]
# Of the 24 frames these are in KITTI's official val split; the point prior learns from the others.
VAL = {f"{number:06d}" for number in (1, 4, 5, 8, 20, 23, 25, 28, 35)}


@dataclass(frozen=True)
class Judged:
    """Evidence of all labels of the weak teacher, and which of them are correct."""

    evidence: Evidence
    right: np.ndarray
    labels: int
    rights: int


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(("val", 134, 17), id="val"),
        pytest.param(("all", 341, 35), id="all", marks=pytest.mark.slow),
    ],
)
def evaluated(request, kitti_root):
    """Return cars of the weak teacher on labeled frames.

    Correct = BEV IoU > 0.7 with a Car or a Van.
    """
    split, labels, rights = request.param
    dataset = KittiDataset(kitti_root)
    detector = RecordedDetector(kitti_root / "recorded" / "pointgnn_T0.csv")
    segmenter = OnnxSegmenter(
        kitti_root / "segmenter" / "deeplabv3_mnv2_pascal_quant.onnx", class_map("voc")
    )
    labeled = [frame_id for frame_id in dataset.frame_ids() if frame_id not in VAL]
    thresholds = learn_thresholds(
        ((dataset.read(name), dataset.annotations(name)) for name in labeled), ("Car",)
    )
    priors = [PointPrior(thresholds), SemanticPrior(segmenter)]
    rows = []
    for index, frame_id in enumerate(sorted(VAL) if split == "val" else dataset.frame_ids()):
        frame = dataset.read(frame_id, image=True)
        found = detector.predict(frame)
        ((similarity, repredicted),) = detector.views(frame_id)
        back = Detections(
            similarity.invert_boxes(repredicted.boxes), repredicted.scores, repredicted.categories
        )
        outcome = match_to_ground_truth(
            found, dataset.annotations(frame_id), MatchSettings(neighbors_are="correct")
        )
        rows.append((
            np.full(len(found), index), found.categories, found.scores,
            consistency(found, back).loss,
            *(prior.score(frame, found)[prior.rho_column] for prior in priors),
            outcome.correct,
        ))  # fmt: skip
    *columns, diff, anno, right = (np.concatenate(column) for column in zip(*rows, strict=True))
    evidence = Evidence(*columns, {"rho_diff": diff, "rho_anno": anno})
    return Judged(evidence, right, labels, rights)


def test_a_few_labels_are_correct_and_most_have_evidence(evaluated):
    """Counts that a change of matching, evaluation or reading would change."""
    assert len(evaluated.evidence) == evaluated.labels
    assert evaluated.right.sum() == evaluated.rights
    assert evaluated.evidence.matched.mean() == pytest.approx(0.775, abs=0.02)


def test_correct_labels_have_smaller_losses(evaluated):
    """Score and consistency loss each separate correct from wrong labels well."""
    trust = -np.nan_to_num(evaluated.evidence.loss, nan=np.inf)
    assert 0.95 < auroc(evaluated.evidence.score, evaluated.right) < 0.98
    assert 0.95 < auroc(trust, evaluated.right) < 0.98


@pytest.mark.parametrize("age", AGES)
def test_the_prior_makes_the_weights_precise(evaluated, age):
    """PSPSL puts over twice as much of its weight on correct labels as the score does."""
    evidence, right = evaluated.evidence, evaluated.right
    by_score = weighted_precision(evidence.score, right)
    spsl = weighted_precision(SPSL().weigh(evidence, age).v, right)
    weights = PSPSL().weigh(evidence, age).v
    assert 0.25 < by_score < 0.35
    assert 0.15 < spsl < 0.52
    assert weighted_precision(weights, right) > max(2 * by_score, 1.5 * spsl)
    assert 0.96 < auroc(weights, right) < 0.99
