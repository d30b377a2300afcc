"""The labels of the frames of an audit, with their evidence and their ground truth."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from sqlalchemy import select

from curate.calibration.features import LabelEvidence
from curate.datasets.base import sequences_of
from curate.detections import Detections
from curate.evaluation.evaluated_labels import AuditedFrame, EvaluatedLabels, evaluate_frames
from curate.evaluation.reliability import Overlap
from curate.weighting.base import Evidence
from db import bulk
from pipelines.assembly import open_policy
from pipelines.engine.plan import Plan
from pipelines.engine.stage import RoundContext
from pipelines.labels.evidence import LabelKeys, read_evidence
from pipelines.labels.label_evidence import read_label_evidence
from pipelines.labels.matching import match_settings, rectangles_in_image
from pipelines.workspace.workspace import Workspace


@dataclass(frozen=True)
class AuditedPart:
    """The labels of a split, or of one fold.

    Attributes:
        workspace: the workspace that they are read from.
        context: their round.
        frames: the names of the frames, in the order of their numbers in `labels`.
        keys: the keys of the labels.
        labels: which of them are correct.
        evidence: what policies weight them by.
        features: what a calibration estimates their probability from.
        repredicted: whether an augmented copy of one of the frames was predicted.
    """

    workspace: Workspace
    context: RoundContext
    frames: tuple[str, ...]
    keys: LabelKeys
    labels: EvaluatedLabels
    evidence: Evidence
    features: LabelEvidence
    repredicted: bool

    def weights(self, name: str) -> np.ndarray:
        """Return the weights of a policy; NaN if the evidence that it rests on was not measured."""
        evidence, age = self.evidence, self.context.age
        unmeasured = np.full(len(evidence), np.nan)
        policy = open_policy(self.workspace.config, name)
        estimates = [getattr(evidence, each) for each in ("probability", "p_value")
                     if each in policy.reads]  # fmt: skip
        if any(np.isnan(column).any() for column in estimates):
            return unmeasured
        v: np.ndarray = policy.weigh(evidence, age).v
        if self.repredicted or v.any() or estimates:
            return v
        # Without repredictions, weights of 0 say something only if perfect ones would not change
        # them.
        consistent = replace(evidence, loss=np.zeros(len(evidence)))
        return unmeasured if policy.weigh(consistent, age).v.any() else v


def read_part(plan: Plan, split: str, overlap: Overlap, failed: set[str]) -> AuditedPart:
    """Return the labels of a split, matched to the ground truth.

    Args:
        plan: the plan of the round.
        split: the split.
        overlap: the overlap to match labels by.
        failed: names of frames to leave out.
    """
    workspace, context = plan.workspace, plan.context
    frames, complete = _evaluated_frames(plan, split, failed)
    keys, evidence = read_evidence(workspace, context.number, complete)
    labels = evaluate_frames(
        _frames(workspace, context, split, frames, workspace.labels(context.number, complete)),
        match_settings(workspace.config, overlap),
    )
    return AuditedPart(
        workspace=workspace,
        context=context,
        frames=tuple(name for _, name in frames),
        keys=keys,
        labels=labels,
        evidence=evidence,
        features=read_label_evidence(workspace, context.number, complete)[1],
        repredicted=_is_repredicted(workspace, context.number, complete),
    )


def before_and_after(
    plan: Plan, split: str, failed: set[str]
) -> Mapping[Overlap, tuple[EvaluatedLabels, EvaluatedLabels]]:
    """Return, by overlap, the labels with the boxes of the detector and with the fused boxes."""
    workspace, context = plan.workspace, plan.context
    frames, complete = _evaluated_frames(plan, split, failed)
    before, after = (
        list(_frames(workspace, context, split, frames, read(context.number, complete)))
        for read in (workspace.predictions, workspace.labels)
    )
    return {
        overlap: (evaluate_frames(before, settings), evaluate_frames(after, settings))
        for overlap in get_args(Overlap)
        for settings in [match_settings(workspace.config, overlap)]
    }


def _evaluated_frames(
    plan: Plan, split: str, failed: set[str]
) -> tuple[list[tuple[int, str]], list[int]]:
    """Return key and name of all evaluated frames, and the keys of those with labels."""
    # Sorted by key, like the evidence.
    frames = sorted(
        (key, name) for name, key in plan.workspace.frames(split).items() if name not in failed
    )
    return frames, plan.complete_frames(plan.graph.round_stage("solve"), split)


def _is_repredicted(workspace: Workspace, round_number: int, frames: Sequence[int]) -> bool:
    """Return whether an augmented copy of one of the frames has been predicted."""
    table = bulk.table("consistency")
    query = select(table.c.frame_id).where(
        table.c.round == round_number, table.c.views > 0, table.c.frame_id.in_(frames)
    )
    return bool(workspace.database.rows(query.limit(1)))


def _frames(
    workspace: Workspace,
    context: RoundContext,
    split: str,
    frames: Sequence[tuple[int, str]],
    labels: Mapping[int, Detections],
) -> Iterator[AuditedFrame]:
    """Yield the frames with their labels; a frame that is not complete has no labels."""
    points = _points(workspace, context.number)
    truth = workspace.ground_truth(split)
    sequences = sequences_of(workspace.dataset, [name for _, name in frames])
    for key, name in frames:
        found = labels.get(key, Detections.empty())
        frame = workspace.dataset.read(name, points=False)
        yield AuditedFrame(
            found,
            truth[name],
            rectangles_in_image(found.boxes, frame),
            np.array([points.get((key, k), np.nan) for k in range(len(found))], dtype=np.float64),
            sequences.get(name, ""),
        )


def _points(workspace: Workspace, round_number: int) -> dict[tuple[int, int], int]:
    """Return the LiDAR points in each label, by frame key and k."""
    table = bulk.table("point_prior")
    query = select(table.c.frame_id, table.c.k, table.c.points).where(table.c.round == round_number)
    return {(frame, k): points for frame, k, points in workspace.database.rows(query)}
