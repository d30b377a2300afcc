"""Audit labels and weights on labeled frames that the teacher has not been trained on.

The frames are treated as if they were unlabeled: the same stages make their labels and evidence,
and the policies weight them (lambda is computed over these frames only). Only then are the labels
matched to the ground truth.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from curate.calibration.model import TooFewLabels
from curate.errors import ConfigError, LeakageError, WorkspaceError
from curate.evaluation.audit import Audit, audit
from curate.evaluation.audit_summary import summary_sentences
from curate.evaluation.counts import describe_others
from curate.evaluation.evaluated_labels import EvaluatedLabels
from curate.evaluation.fusion_effect import FusionEffect, fusion_effects
from curate.evaluation.reliability import Overlap
from curate.weighting.base import Evidence
from pipelines.assembly import check_executor, describe_score, open_policy, score_meaning
from pipelines.assessment.audited_labels import AuditedPart, before_and_after, read_part
from pipelines.assessment.audited_probabilities import (
    by_the_round,
    check_calibration,
    cross_fitted,
)
from pipelines.assessment.trained_folds import ReportCallback, trained_folds
from pipelines.engine.plan import Plan
from pipelines.engine.progress import Progress
from pipelines.engine.rounds import is_trainable
from pipelines.engine.runner import Report, check_inputs, open_executor, run_frames
from pipelines.engine.stage import RoundContext
from pipelines.round import open_plan
from pipelines.workspace.workspace import Workspace

POLICIES = ("pspsl", "spsl", "threshold", "uniform")
EVIDENCE: Mapping[str, Callable[[Evidence], np.ndarray]] = {
    "score": lambda evidence: evidence.score,
    "rho_det": lambda evidence: evidence.rho_det,
    "consistency": lambda evidence: np.where(evidence.matched, np.exp(-evidence.loss), 0.0),
    "probability": lambda evidence: evidence.probability,
}
"""Evidence to audit like a weight, each in [0, 1]; no training uses it as a weight directly."""
CALIBRATED = ("learned", "probability")
"""Names that are audited by default only where there are probabilities."""


@dataclass(frozen=True)
class AuditRequest:
    """The frames, policies and settings of an audit.

    Attributes:
        split: "val", or "labeled" for a detector that has not been trained on these frames.
        folds: number of held-out folds of X_l to use instead of a split; 0 for none.
        round_number: e; None for the first round without a student.
        names: names of policies and of `EVIDENCE`; by default `POLICIES`, `EVIDENCE`, and
            `CALIBRATED` where there are probabilities.
        overlap: the overlap to match labels by, "bev" or "3d".
        replicates: number of bootstrap draws.
        reference: the name whose weighted recall the others are brought to; None for run.method.
    """

    split: str = "val"
    folds: int = 0
    round_number: int | None = None
    names: tuple[str, ...] = ()
    overlap: Overlap = "bev"
    replicates: int = 1000
    reference: str | None = None

    @property
    def frames(self) -> str:
        """The audited frames as text: the split, or the number of folds."""
        return f"{self.folds} folds" if self.folds else self.split

    @property
    def candidates(self) -> tuple[str, ...]:
        """The names to audit, if they can be."""
        return self.names or (*POLICIES, "learned", *EVIDENCE)


@dataclass(frozen=True)
class AuditedRound:
    """The result of an audit.

    Attributes:
        request: see `AuditRequest`.
        names: the audited names.
        context: the audited round; with folds, the round of the first fold.
        figures: the figures of the audit.
        reports: the reports of the stages.
        unmeasured: the names in the request with weights that could not be measured.
        score_meaning: what a score of the detector estimates; None if unknown.
        probabilities: a sentence on where probabilities are from; "" without any.
        missing: why names in `CALIBRATED` were not measured.
        fusion: the effect of fused boxes by both overlaps; empty without `repredict.fuse`.
    """

    request: AuditRequest
    names: tuple[str, ...]
    context: RoundContext
    figures: Audit
    reports: tuple[Report, ...]
    unmeasured: tuple[str, ...] = ()
    score_meaning: str | None = None
    probabilities: str = ""
    missing: str = ""
    fusion: tuple[FusionEffect, ...] = ()

    @property
    def policies(self) -> tuple[str, ...]:
        """The names that are policies."""
        return tuple(name for name in self.names if name not in EVIDENCE)

    @property
    def evidence(self) -> tuple[str, ...]:
        """The names that are evidence."""
        return tuple(name for name in self.names if name in EVIDENCE)


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

    parts, fused = [], []
    for plan, split, done in _audited_splits(workspace, request, progress, record):
        if split == "val" and not request.folds and {*CALIBRATED} & {*request.names}:
            check_calibration(workspace, plan.context.number)
        failed = _run_stages(plan, split, progress, done)
        parts.append(read_part(plan, split, request.overlap, failed))
        if workspace.config.repredict.fuse:
            fused.append(before_and_after(plan, split, failed))
    parts, origin, missing = _with_probabilities(workspace, request, parts)
    weights = {
        name: np.concatenate([_weights(part, name) for part in parts])
        for name in request.candidates
    }
    unmeasured = tuple(name for name, v in weights.items() if np.isnan(v).any())
    if not request.names:
        for name in {*CALIBRATED} & {*unmeasured}:
            del weights[name]
    context = parts[0].context
    figures = audit(
        EvaluatedLabels.joined([part.labels for part in parts]),
        weights,
        workspace.config.dataset.categories,
        np.random.default_rng([workspace.config.run.seed, context.number]),
        reference=request.reference or workspace.config.run.method,
        replicates=request.replicates,
    )
    return AuditedRound(
        request,
        tuple(weights),
        context,
        figures,
        tuple(reports),
        tuple(name for name in unmeasured if name in weights),
        score_meaning(workspace.config),
        origin,
        missing,
        _fusion_effects(workspace, request, context, fused),
    )


def describe_audit(found: AuditedRound) -> list[str]:
    """Return a summary of the audit in sentences, with its limitations."""
    request = found.request
    sentences = summary_sentences(found.figures, found.policies, found.evidence)
    without_priors = [name for name in found.unmeasured if name == "rho_det"]
    without_fit = [name for name in found.unmeasured if name in CALIBRATED]
    without_copies = [
        name for name in found.unmeasured if name not in (*without_priors, *without_fit)
    ]
    if without_copies:
        sentences.append(
            f"Not measured: {', '.join(without_copies)}, because no augmented copy of these frames "
            "was predicted."
        )
    if without_priors:
        sentences.append("Not measured: rho_det, because run.priors is empty.")
    if without_fit:
        sentences.append(f"Not measured: {', '.join(without_fit)}: {found.missing}.")
    if {*CALIBRATED} & {*found.names} - {*without_fit}:
        sentences.append(found.probabilities)
    left_out = [name for name in CALIBRATED if name not in found.names]
    if left_out and found.missing and not request.names:
        sentences.append(f"Left out: {', '.join(left_out)}: {found.missing}.")
    if not found.figures.counts.counted:
        sentences.append(
            "No object counts: the ground truth of these frames has "
            + (", ".join(describe_others(found.figures.counts)) or "no objects")
            + ". Check dataset.categories."
        )
    if request.reference not in (None, found.figures.reference):
        sentences.append(
            f"{request.reference} gives no weight here, so the reference is "
            f"{found.figures.reference or 'missing'}."
        )
    if "score" in found.names:
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
        *names,
    )
    return workspace.root / "reports" / f"{'-'.join(parts)}.{suffix}"


def _check(workspace: Workspace, request: AuditRequest) -> None:
    """Check the request, so that errors appear before the detector runs."""
    if request.split not in ("val", "labeled"):
        raise ConfigError(
            f"--split {request.split}: use val or labeled; other frames have no ground truth"
        )
    if request.reference not in (None, *request.candidates):
        raise ConfigError(
            f"--reference {request.reference}: not audited; use one of "
            f"{', '.join(request.candidates)}"
        )
    check_executor(workspace.config)
    for name in {*request.candidates} - {*EVIDENCE}:
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
    for fold, done in trained_folds(workspace, request.folds, progress, record):
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


def _with_probabilities(
    workspace: Workspace, request: AuditRequest, parts: list[AuditedPart]
) -> tuple[list[AuditedPart], str, str]:
    """Return the labels with probabilities, where those are from, and why some are missing."""
    policies = {*request.candidates} - {*EVIDENCE}
    if not {*CALIBRATED} & {*request.candidates}:
        return parts, "", ""
    try:
        if request.folds or request.split == "labeled":
            generator = np.random.default_rng(workspace.config.run.seed)
            parts, origin = cross_fitted(workspace, parts, generator)
            return parts, origin, "solve.learned.max_wrong needs val frames to be audited on"
        part, origin = by_the_round(parts[0], sorted(policies))
        calibrate = workspace.config.calibrate
        if (calibrate.overlap, calibrate.thresholds) != (request.overlap, "kitti"):
            origin += (
                f" It estimates the probability of being correct by {calibrate.overlap} IoU and "
                f"{calibrate.thresholds} thresholds ([calibrate]), which are not those of this "
                "audit."
            )
    except (TooFewLabels, ConfigError, WorkspaceError) as error:
        return parts, "", str(error)
    return [part], origin, ""


def _weights(part: AuditedPart, name: str) -> np.ndarray:
    """Return the weights of a policy, or evidence; NaN if what it rests on was not measured."""
    unmeasured = np.full(len(part.evidence), np.nan)
    if name == "rho_det" and not part.workspace.config.run.priors:
        return unmeasured
    if name == "consistency" and not part.repredicted:
        return unmeasured
    return EVIDENCE[name](part.evidence) if name in EVIDENCE else part.weights(name)
