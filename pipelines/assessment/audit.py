"""Audit labels and weights on labeled frames that the teacher has not been trained on.

The frames are treated as if they were unlabeled: the same stages make their labels and evidence,
and the policies weight them (lambda is computed over these frames only). Only then are the labels
matched to the ground truth.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
from sqlalchemy import select

from curate.detections import Detections
from curate.errors import ConfigError, LeakageError, WorkspaceError
from curate.evaluation.audit import Audit, audit
from curate.evaluation.audit_summary import summary_sentences
from curate.evaluation.counts import describe_others
from curate.evaluation.evaluated_labels import AuditedFrame, EvaluatedLabels, evaluate_frames
from curate.evaluation.fusion_effect import FusionEffect, fusion_effects
from curate.evaluation.reliability import Overlap
from curate.weighting.base import Evidence
from db import bulk
from pipelines.assembly import check_executor, describe_score, open_policy, score_meaning
from pipelines.engine.plan import Plan
from pipelines.engine.progress import Progress
from pipelines.engine.rounds import is_trainable
from pipelines.engine.runner import Report, check_inputs, open_executor, run_first, run_frames
from pipelines.engine.stage import RoundContext
from pipelines.labels.evidence import read_evidence
from pipelines.labels.matching import match_settings, rectangles_in_image
from pipelines.round import graph_of, open_plan
from pipelines.workspace.folds import open_folds
from pipelines.workspace.workspace import Workspace

POLICIES = ("pspsl", "spsl", "threshold", "uniform")
EVIDENCE: Mapping[str, Callable[[Evidence], np.ndarray]] = {
    "score": lambda evidence: evidence.score,
    "rho_det": lambda evidence: evidence.rho_det,
    "consistency": lambda evidence: np.where(evidence.matched, np.exp(-evidence.loss), 0.0),
}
"""Evidence to audit like a weight, each in [0, 1]; no training uses it as a weight directly."""

ReportCallback = Callable[[Report], None]


@dataclass(frozen=True)
class AuditRequest:
    """The frames, policies and settings of an audit.

    Attributes:
        split: "val", or "labeled" for a detector that has not been trained on these frames.
        folds: number of held-out folds of X_l to use instead of a split; 0 for none.
        round_number: e; None for the first round without a student.
        names: names of policies and of `EVIDENCE`.
        overlap: the overlap to match labels by, "bev" or "3d".
        replicates: number of bootstrap draws.
    """

    split: str = "val"
    folds: int = 0
    round_number: int | None = None
    names: tuple[str, ...] = (*POLICIES, *EVIDENCE)
    overlap: Overlap = "bev"
    replicates: int = 1000

    @property
    def frames(self) -> str:
        """The audited frames as text: the split, or the number of folds."""
        return f"{self.folds} folds" if self.folds else self.split

    @property
    def policies(self) -> tuple[str, ...]:
        """The names that are policies."""
        return tuple(name for name in self.names if name not in EVIDENCE)

    @property
    def evidence(self) -> tuple[str, ...]:
        """The names that are evidence."""
        return tuple(name for name in self.names if name in EVIDENCE)


@dataclass(frozen=True)
class AuditedRound:
    """The result of an audit.

    Attributes:
        request: see `AuditRequest`.
        context: the audited round; with folds, the round of the first fold.
        figures: the figures of the audit.
        reports: the reports of the stages.
        unmeasured: the names in the request with weights that could not be measured.
        score_meaning: what a score of the detector estimates; None if unknown.
        fusion: the effect of fused boxes by both overlaps; empty without `repredict.fuse`.
    """

    request: AuditRequest
    context: RoundContext
    figures: Audit
    reports: tuple[Report, ...]
    unmeasured: tuple[str, ...] = ()
    score_meaning: str | None = None
    fusion: tuple[FusionEffect, ...] = ()


def run_audit(
    workspace: Workspace, request: AuditRequest, progress: Progress, on_report: ReportCallback
) -> AuditedRound:
    """Run the stages on the frames, weight their labels and match them to the ground truth.

    Args:
        workspace: see `Workspace`.
        request: see `AuditRequest`.
        progress: see `Progress`.
        on_report: called with the report of each stage when it ends.

    Raises:
        ConfigError: if the request is invalid.
        LeakageError: if the teacher has been trained on the frames.
        WorkspaceError: if the split has no frames.
    """
    _check(workspace, request)
    reports: list[Report] = []

    def record(report: Report) -> None:
        reports.append(report)
        on_report(report)

    parts, contexts, fused = [], [], []
    for plan, split, done in _audited_splits(workspace, request, progress, record):
        failed = _run_stages(plan, split, progress, done)
        parts.append(_evaluate(plan, split, request, failed))
        if workspace.config.repredict.fuse:
            fused.append(_before_and_after(plan, split, failed))
        contexts.append(plan.context)
    labels = EvaluatedLabels.joined([part for part, _ in parts])
    weights = {
        name: np.concatenate([weights[name] for _, weights in parts]) for name in request.names
    }
    figures = audit(
        labels,
        weights,
        workspace.config.dataset.categories,
        np.random.default_rng([workspace.config.run.seed, contexts[0].number]),
        replicates=request.replicates,
    )
    unmeasured = tuple(name for name, v in weights.items() if np.isnan(v).any())
    meaning = score_meaning(workspace.config)
    effects = _fusion_effects(workspace, request, contexts[0], fused)
    return AuditedRound(request, contexts[0], figures, tuple(reports), unmeasured, meaning, effects)


def describe_audit(found: AuditedRound) -> list[str]:
    """Return a summary of the audit in sentences, with its limitations."""
    request = found.request
    sentences = summary_sentences(found.figures, request.policies, request.evidence)
    without_priors = [name for name in found.unmeasured if name == "rho_det"]
    without_copies = [name for name in found.unmeasured if name != "rho_det"]
    if without_copies:
        sentences.append(
            f"Not measured: {', '.join(without_copies)}, because no augmented copy of these frames "
            "was predicted."
        )
    if without_priors:
        sentences.append("Not measured: rho_det, because run.priors is empty.")
    if not found.figures.counts.counted:
        sentences.append(
            "No object counts: the ground truth of these frames has "
            + (", ".join(describe_others(found.figures.counts)) or "no objects")
            + ". Check dataset.categories."
        )
    if "score" in request.names:
        sentences.append(f"The score {describe_score(found.score_meaning)}.")
    if request.split == "labeled" and not request.folds:
        sentences.append(
            "The thresholds of the point prior were computed from the audited frames, so its "
            "figures may be too good; --folds computes them from other frames."
        )
    return sentences


def picture_path(workspace: Workspace, found: AuditedRound, suffix: str = "png") -> Path:
    """Return the path of the reliability diagram."""
    frames = found.request.frames.replace(" ", "-")
    names = found.request.names
    parts = (
        f"audit-round-{found.context.number:02d}",
        frames,
        found.request.overlap,
        *(() if names == AuditRequest.names else names),
    )
    return workspace.root / "reports" / f"{'-'.join(parts)}.{suffix}"


def _check(workspace: Workspace, request: AuditRequest) -> None:
    """Check the request, so that errors appear before the detector runs."""
    if request.split not in ("val", "labeled"):
        raise ConfigError(
            f"--split {request.split}: use val or labeled; other frames have no ground truth"
        )
    check_executor(workspace.config)
    for name in request.policies:
        open_policy(workspace.config, name)
    if request.folds:
        if request.round_number not in (None, 1):
            raise ConfigError(
                "--folds audits the first round only, because its teachers are trained on X_l "
                "only; omit --round"
            )
    elif request.split == "labeled" and is_trainable(workspace):
        raise LeakageError(
            "--split labeled: the teacher has been trained on these frames; use --folds 5, or "
            "--split val"
        )
    elif not workspace.frames(request.split):
        raise WorkspaceError(f"there are no {request.split} frames; use --folds 5 to hold some out")


def _audited_splits(
    workspace: Workspace, request: AuditRequest, progress: Progress, record: ReportCallback
) -> Iterator[tuple[Plan, str, ReportCallback]]:
    """Yield the plan and the split to audit, and the callback for the reports of its stages."""
    if not request.folds:
        plan = open_plan(workspace, request.round_number, split=request.split)
        yield plan, request.split, record
        return
    for number, fold in enumerate(open_folds(workspace, request.folds), start=1):
        suffix = f" {number}/{request.folds}"

        def done(report: Report, suffix: str = suffix) -> None:
            record(replace(report, stage=report.stage + suffix))

        for first in graph_of(fold).first_stages:
            done(run_first(fold, first, progress))
        yield open_plan(fold, 1, split="val"), "val", done


def _run_stages(plan: Plan, split: str, progress: Progress, done: ReportCallback) -> set[str]:
    """Run every frame stage and return the frames that failed in any of them."""
    check_inputs(plan, plan.graph.frames_stages, split)
    failed: set[str] = set()
    with open_executor(plan.workspace) as executor:
        for stage in plan.graph.frames_stages:
            report = run_frames(plan, stage, executor, progress, split)
            failed |= {frame for frame, _ in report.errors}
            done(report)
    return failed


def _evaluate(
    plan: Plan, split: str, request: AuditRequest, failed: set[str]
) -> tuple[EvaluatedLabels, dict[str, np.ndarray]]:
    """Return the evaluated labels of a split, and their weights by policy."""
    workspace, context = plan.workspace, plan.context
    frames, complete = _evaluated_frames(plan, split, failed)
    _, evidence = read_evidence(workspace, context.number, complete)
    repredicted = _is_repredicted(workspace, context.number, complete)
    labels = evaluate_frames(
        _frames(workspace, context, split, frames, workspace.labels(context.number, complete)),
        match_settings(workspace.config, request.overlap),
    )
    return labels, {
        name: _weights(workspace, name, evidence, context, repredicted=repredicted)
        for name in request.names
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


def _before_and_after(
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


def _fusion_effects(
    workspace: Workspace,
    request: AuditRequest,
    context: RoundContext,
    parts: Sequence[Mapping[Overlap, tuple[EvaluatedLabels, EvaluatedLabels]]],
) -> tuple[FusionEffect, ...]:
    """Return the effect of fusion on the labels of all parts; nothing without fusion."""
    return tuple(
        effect
        for overlap in (get_args(Overlap) if parts else ())
        for effect in fusion_effects(
            overlap,
            [part[overlap] for part in parts],
            workspace.config.dataset.categories,
            np.random.default_rng([workspace.config.run.seed, context.number]),
            replicates=request.replicates,
        )
    )


def _weights(
    workspace: Workspace,
    name: str,
    evidence: Evidence,
    context: RoundContext,
    *,
    repredicted: bool,
) -> np.ndarray:
    """Return the weights of a policy, or evidence; NaN if what it rests on was not measured."""
    unmeasured = np.full(len(evidence), np.nan)
    if name == "rho_det" and not workspace.config.run.priors:
        return unmeasured
    if name in EVIDENCE:
        return unmeasured if name == "consistency" and not repredicted else EVIDENCE[name](evidence)
    policy = open_policy(workspace.config, name)
    v: np.ndarray = policy.weigh(evidence, context.age).v
    if repredicted or v.any():
        return v
    # Without repredictions, weights of 0 say something only if perfect ones would not change them.
    consistent = replace(evidence, loss=np.zeros(len(evidence)))
    return unmeasured if policy.weigh(consistent, context.age).v.any() else v


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
    for key, name in frames:
        found = labels.get(key, Detections.empty())
        frame = workspace.dataset.read(name, points=False)
        yield AuditedFrame(
            found,
            truth[name],
            rectangles_in_image(found.boxes, frame),
            np.array([points.get((key, k), np.nan) for k in range(len(found))], dtype=np.float64),
        )


def _points(workspace: Workspace, round_number: int) -> dict[tuple[int, int], int]:
    """Return the LiDAR points in each label, by frame key and k."""
    table = bulk.table("point_prior")
    query = select(table.c.frame_id, table.c.k, table.c.points).where(table.c.round == round_number)
    return {(frame, k): points for frame, k, points in workspace.database.rows(query)}
