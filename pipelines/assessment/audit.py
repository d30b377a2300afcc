"""The audit: labeled frames that the teacher has not seen, treated as if they were unlabeled.

The same stages make their labels and gather the evidence, and the policies weigh them over these
frames alone, lambda included. Only then is the ground truth asked.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from sqlalchemy import select

from curate.detections import Detections
from curate.errors import ConfigError, LeakageError, WorkspaceError
from curate.evaluation.audit import Audit, audit
from curate.evaluation.audit_summary import summary_sentences
from curate.evaluation.judged_labels import AuditedFrame, JudgedLabels, judge_frames
from curate.evaluation.kitti_rules import MIN_OVERLAPS
from curate.evaluation.reliability import JudgeSettings, Overlap
from curate.geometry.projection import image_rectangles
from curate.weighting.base import Evidence
from db import bulk
from pipelines.assembly import check_executor, open_policy
from pipelines.assessment.audit_folds import open_folds
from pipelines.engine.plan import Plan
from pipelines.engine.progress import Progress
from pipelines.engine.rounds import is_trainable
from pipelines.engine.runner import Report, open_executor, run_first, run_frames
from pipelines.engine.stage import RoundContext
from pipelines.labels.evidence import read_evidence
from pipelines.round import graph_of, open_plan
from pipelines.workspace.config import Config
from pipelines.workspace.workspace import Workspace

POLICIES = ("pspsl", "spsl", "threshold", "uniform")
EVIDENCE: Mapping[str, Callable[[Evidence], np.ndarray]] = {
    "score": lambda evidence: evidence.score,
    "rho_det": lambda evidence: evidence.rho_det,
    "consistency": lambda evidence: np.where(evidence.matched, np.exp(-evidence.loss), 0.0),
}
"""Judges that no training uses by themselves: what the weights are made of, each within [0, 1]."""
OTHER_IOU = 0.5  # for categories that KITTI does not evaluate

Tell = Callable[[Report], None]


@dataclass(frozen=True)
class AuditRequest:
    """What to audit.

    Attributes:
        split: "val", or "labeled" for a detector that has not seen these frames.
        folds: held-out folds of X_l in place of a split; 0 for none.
        round_number: e; None for the first that has no student yet.
        names: policies and pieces of `EVIDENCE`.
        overlap: by which a label is right, "bev" or "3d".
        replicates: draws of the bootstrap.
    """

    split: str = "val"
    folds: int = 0
    round_number: int | None = None
    names: tuple[str, ...] = (*POLICIES, *EVIDENCE)
    overlap: Overlap = "bev"
    replicates: int = 1000

    @property
    def frames(self) -> str:
        """Which frames, in words."""
        return f"{self.folds} folds" if self.folds else self.split

    @property
    def policies(self) -> tuple[str, ...]:
        """The names that are policies."""
        return tuple(name for name in self.names if name not in EVIDENCE)

    @property
    def evidence(self) -> tuple[str, ...]:
        """The names that are pieces of evidence."""
        return tuple(name for name in self.names if name in EVIDENCE)


@dataclass(frozen=True)
class AuditedRound:
    """An audit and what it is about.

    Attributes:
        request: see `AuditRequest`.
        context: the round; that of the first fold.
        figures: what was found.
        reports: what the stages did.
    """

    request: AuditRequest
    context: RoundContext
    figures: Audit
    reports: tuple[Report, ...]


def run_audit(
    workspace: Workspace, request: AuditRequest, progress: Progress, tell: Tell
) -> AuditedRound:
    """Bring the frames up to date, weighs their labels and asks the truth.

    Args:
        workspace: see `Workspace`.
        request: see `AuditRequest`.
        progress: see `Progress`.
        tell: takes what each stage did, as it ends.

    Raises:
        ConfigError: if the request makes no sense.
        LeakageError: if the teacher has learned from the frames.
        WorkspaceError: if there are no such frames.
    """
    _check(workspace, request)
    reports: list[Report] = []

    def note(report: Report) -> None:
        reports.append(report)
        tell(report)

    parts, contexts = [], []
    for plan, split, done in _places(workspace, request, progress, note):
        failed = _run_stages(plan, split, progress, done)
        parts.append(_judge(plan, split, request, failed))
        contexts.append(plan.context)
    judged = JudgedLabels.joined([part for part, _ in parts])
    weights = {
        name: np.concatenate([weights[name] for _, weights in parts]) for name in request.names
    }
    figures = audit(
        judged,
        weights,
        workspace.config.dataset.categories,
        np.random.default_rng([workspace.config.run.seed, contexts[0].number]),
        replicates=request.replicates,
    )
    return AuditedRound(request, contexts[0], figures, tuple(reports))


def describe_audit(found: AuditedRound) -> list[str]:
    """What the audit means, with its own limits."""
    request = found.request
    words = summary_sentences(found.figures, request.policies, request.evidence)
    if request.split == "labeled" and not request.folds:
        words.append(
            "The point prior has its thresholds from these very frames, which may flatter it; "
            "with --folds it has them from other frames."
        )
    return words


def picture_path(workspace: Workspace, found: AuditedRound, suffix: str = "png") -> Path:
    """Return where the reliability diagram belongs."""
    frames = found.request.frames.replace(" ", "-")
    name = f"audit-round-{found.context.number:02d}-{frames}-{found.request.overlap}.{suffix}"
    return workspace.root / "reports" / name


def _check(workspace: Workspace, request: AuditRequest) -> None:
    """Reject before the detector runs what could not be audited after it."""
    if request.split not in ("val", "labeled"):
        raise ConfigError(
            f"--split {request.split}: only val and labeled frames have ground truth to ask"
        )
    check_executor(workspace.config)
    for name in request.policies:
        open_policy(workspace.config, name)
    if request.folds:
        if request.round_number not in (None, 1):
            raise ConfigError("--folds audits the first round: its teachers learn from X_l alone")
    elif request.split == "labeled" and is_trainable(workspace):
        raise LeakageError(
            "--split labeled: the teacher has learned from these frames and knows their labels; "
            "use --folds 5, or --split val"
        )
    elif not workspace.frames(request.split):
        raise WorkspaceError(f"there are no {request.split} frames; use --folds 5 to hold some out")


def _places(
    workspace: Workspace, request: AuditRequest, progress: Progress, note: Tell
) -> Iterator[tuple[Plan, str, Tell]]:
    """Yield the rounds and splits to audit, and who is told of the stages there."""
    if not request.folds:
        yield open_plan(workspace, request.round_number), request.split, note
        return
    for number, fold in enumerate(open_folds(workspace, request.folds), start=1):
        place = f" {number}/{request.folds}"

        def done(report: Report, place: str = place) -> None:
            note(replace(report, stage=report.stage + place))

        for first in graph_of(fold).first_stages:
            done(run_first(fold, first, progress))
        yield open_plan(fold, 1), "val", done


def _run_stages(plan: Plan, split: str, progress: Progress, done: Tell) -> set[str]:
    """Bring every frame stage up to date; the frames that failed in one."""
    failed: set[str] = set()
    with open_executor(plan.workspace) as executor:
        for stage in plan.graph.frames_stages:
            report = run_frames(plan, stage, executor, progress, split)
            failed |= {frame for frame, _ in report.errors}
            done(report)
    return failed


def _judge(
    plan: Plan, split: str, request: AuditRequest, failed: set[str]
) -> tuple[JudgedLabels, dict[str, np.ndarray]]:
    """Return the labels of a split with what the truth says of them, and their weights."""
    workspace, context = plan.workspace, plan.context
    # By key, as the evidence is ordered.
    frames = sorted(
        (key, name) for name, key in workspace.frames(split).items() if name not in failed
    )
    complete = plan.complete_frames(plan.graph.round_stage("solve"), split)
    _, evidence = read_evidence(workspace, context.number, complete)
    judged = judge_frames(
        _frames(workspace, context, split, frames, complete),
        judge_settings(workspace.config, request.overlap),
    )
    return judged, {
        name: EVIDENCE[name](evidence)
        if name in EVIDENCE
        else open_policy(workspace.config, name).weigh(evidence, context.age).v
        for name in request.names
    }


def judge_settings(config: Config, overlap: Overlap) -> JudgeSettings:
    """When a label is right: KITTI's overlaps for the configured categories."""
    categories = config.dataset.categories
    return JudgeSettings(
        overlap=overlap,
        minimum_iou={name: MIN_OVERLAPS.get(name, OTHER_IOU) for name in categories},
    )


def _frames(
    workspace: Workspace,
    context: RoundContext,
    split: str,
    frames: Sequence[tuple[int, str]],
    complete: Sequence[int],
) -> Iterator[AuditedFrame]:
    """The frames with their labels, of which only those of complete frames would be weighed."""
    labels = workspace.predictions(context.number, complete)
    points = _points(workspace, context.number)
    truth = workspace.ground_truth(split)
    for key, name in frames:
        own = labels.get(key, Detections.empty())
        frame = workspace.dataset.read(name, points=False)
        yield AuditedFrame(
            own,
            truth[name],
            image_rectangles(own.boxes, frame.calibration, frame.image_size),
            np.array([points.get((key, k), np.nan) for k in range(len(own))], dtype=np.float64),
        )


def _points(workspace: Workspace, round_number: int) -> dict[tuple[int, int], int]:
    """LiDAR points in each label, by frame and k."""
    table = bulk.table("point_prior")
    query = select(table.c.frame_id, table.c.k, table.c.points).where(table.c.round == round_number)
    return {(frame, k): points for frame, k, points in workspace.database.rows(query)}
