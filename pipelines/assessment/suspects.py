"""Find suspects among the labels of X_l and val, by teachers that were not trained on them.

The labels of X_l are compared with the predictions of fold teachers, each trained without its
fold, and those of val with the predictions of the round's teacher. A detector that curate does not
train predicts both itself.
"""

import csv
import io
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from curate.detections import Annotations, Detections, empty_boxes
from curate.errors import ConfigError, CurateError, WorkspaceError
from curate.evaluation.proposals import Proposals, mean_sizes, propose_objects
from curate.evaluation.reliability import DONT_CARE, MatchSettings, match_to_ground_truth
from curate.evaluation.suspects import CheckedFrame, Suspect, find_suspects
from curate.files.atomic import replace_file
from curate.frames import Frame
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.geometry.projection import camera_of_boxes
from curate.priors.semantic import SemanticPrior
from curate.viewing.canvas import save_png
from curate.viewing.close_up import CloseUpLabel, draw_close_up
from db.models import BOX_COLUMNS
from pipelines.assembly import check_executor, open_segmenter
from pipelines.assessment.trained_folds import trained_folds
from pipelines.engine.progress import Progress
from pipelines.engine.rounds import is_trainable, recorded_config
from pipelines.engine.runner import Report, check_inputs, open_executor, run_frames
from pipelines.labels.matching import rectangles_in_image
from pipelines.round import open_plan
from pipelines.workspace.workspace import Workspace

_log = logging.getLogger(__name__)

SPLITS = ("labeled", "val")
PICTURES = "suspects"
COLUMNS = (
    "rank", "split", "frame", "k", "kind", "category", "suspicion", "reason", "predicted_category",
    "predicted_score", *BOX_COLUMNS, "label_file", "picture", "decision",
)  # fmt: skip
"""The columns of the table; `decision` is empty, for the person who works through it."""


@dataclass(frozen=True)
class SuspectRequest:
    """Which labels to check.

    Attributes:
        splits: "labeled", "val", or both.
        folds: number of held-out folds of X_l, for a detector that curate trains.
        round_number: round whose teacher predicts val; None for the first without a student.
        minimum: lowest suspicion to list.
    """

    splits: tuple[str, ...] = SPLITS
    folds: int = 5
    round_number: int | None = None
    minimum: float = 0.7


@dataclass(frozen=True)
class FoundSuspects:
    """The suspects, the most suspicious first, and what was checked.

    Attributes:
        suspects: see `Suspect`; their frames are numbers of `frames`.
        frames: the checked frames.
        splits: the split of each checked frame.
        labels: number of checked labels of configured categories.
        teachers: a sentence on who predicted.
        reports: the reports of the stages.
    """

    suspects: tuple[Suspect, ...]
    frames: tuple[CheckedFrame, ...]
    splits: tuple[str, ...]
    labels: int
    teachers: str
    reports: tuple[Report, ...]


def run_suspects(
    workspace: Workspace,
    request: SuspectRequest,
    progress: Progress,
    on_report: Callable[[Report], None],
) -> FoundSuspects:
    """Predict the labeled frames with held-out teachers, and return the suspects.

    Args:
        workspace: see `Workspace`.
        request: see `SuspectRequest`.
        progress: see `Progress`.
        on_report: called with the report of each stage when it ends.

    Raises:
        ConfigError: if a split or the number of folds is invalid.
        WorkspaceError: if there are no frames to check, or the round has no teacher yet.
    """
    splits = _splits_to_check(workspace, request)
    check_executor(workspace.config)
    reports: list[Report] = []

    def record(report: Report) -> None:
        reports.append(report)
        on_report(report)

    measure = _Measure(workspace)
    frames: list[CheckedFrame] = []
    of_split: list[str] = []
    for split in reversed(splits):  # val first: it needs no further training
        held_out = is_trainable(workspace) and split == "labeled"
        if held_out:
            predicted = _predict_folds(workspace, request.folds, progress, record)
        else:
            predicted = iter([_predict(workspace, split, request.round_number, progress, record)])
        found = {name: labels for each in predicted for name, labels in each.items()}
        with progress.track(f"compare {split}", len(found)) as advance:
            for checked in measure.frames(split, found):
                frames.append(checked)
                of_split.append(split)
                advance(1, "")
    frames = _within_coverage(frames, measure.seen)
    categories = workspace.config.dataset.categories
    suspects = find_suspects(frames, categories, request.minimum)
    labels = sum(int(np.isin(each.truth.categories, categories).sum()) for each in frames)
    return FoundSuspects(
        tuple(suspects), tuple(frames), tuple(of_split), labels,
        _describe_teachers(workspace, splits, request), tuple(reports),
    )  # fmt: skip


def suspect_rows(workspace: Workspace, found: FoundSuspects) -> list[dict[str, Any]]:
    """Return a row with the columns `COLUMNS` for each suspect; the pictures are not yet known."""
    rows = []
    for rank, suspect in enumerate(found.suspects, start=1):
        frame = found.frames[suspect.frame]
        path = workspace.dataset.files(frame.frame).label
        predicted = suspect.prediction >= 0
        box = _box(frame, suspect)
        rows.append(
            {
                "rank": rank,
                "split": found.splits[suspect.frame],
                "frame": frame.frame,
                "k": suspect.label if suspect.label >= 0 else None,
                "kind": suspect.kind,
                "category": suspect.category,
                "suspicion": round(suspect.suspicion, 4),
                "reason": suspect.reason,
                "predicted_category": str(frame.found.categories[suspect.prediction])
                if predicted
                else None,
                "predicted_score": round(float(frame.found.scores[suspect.prediction]), 4)
                if predicted
                else None,
                **dict(zip(BOX_COLUMNS, (round(value, 4) for value in box.tolist()), strict=True)),
                "label_file": None if path is None else str(path),
                "picture": None,
                "decision": None,
            }
        )
    return rows


def draw_suspects(
    workspace: Workspace, found: FoundSuspects, rows: Sequence[dict[str, Any]], progress: Progress
) -> Path:
    """Draw a close-up of each row's suspect, and enter its path in the row; return the folder.

    The label is solid and the prediction that contradicts it dashed. A missing label shows the
    prediction alone.
    """
    folder = workspace.root / "pictures" / PICTURES
    folder.mkdir(parents=True, exist_ok=True)
    for former in folder.glob("*.png"):
        former.unlink()
    with progress.track("pictures", len(rows)) as advance:
        for row in rows:
            suspect = found.suspects[row["rank"] - 1]
            checked = found.frames[suspect.frame]
            frame = workspace.dataset.read(checked.frame, image=True)
            other = None
            if suspect.label >= 0 and suspect.prediction >= 0:
                other = checked.found.boxes[suspect.prediction]
            label = CloseUpLabel(_box(checked, suspect), suspect.suspicion, other)
            number = "new" if suspect.label < 0 else f"k{suspect.label}"
            path = folder / f"{row['rank']:04d}-{checked.frame}-{number}.png"
            save_png(path, draw_close_up(frame, label))
            row["picture"] = workspace.relative(path)
            advance(1, "")
    return folder


def write_table(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write the rows as a CSV file."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    replace_file(path, text.getvalue().encode())


@dataclass
class _Measure:
    """Counts points and pixels of labels and predictions.

    Attributes:
        workspace: see `Workspace`.
    """

    workspace: Workspace

    def __post_init__(self) -> None:
        config = self.workspace.config
        shows = "semantic" in config.run.priors
        self.segmenter = open_segmenter(config) if shows else None
        self.prior = SemanticPrior(self.segmenter) if shows else None
        truth = list(self.workspace.ground_truth(*SPLITS).values())
        self.sizes = mean_sizes(truth, config.dataset.categories)
        # Of each frame, whether a camera shows each label and each prediction.
        self.seen: list[tuple[np.ndarray, np.ndarray]] = []

    def frames(self, split: str, found: dict[str, Detections]) -> Iterator[CheckedFrame]:
        """Yield the predicted frames of a split; unreadable ones are reported and left out."""
        truth = self.workspace.ground_truth(split)
        for name, predictions in found.items():
            try:
                yield self._measure(name, truth[name], predictions)
            except CurateError as error:
                _log.warning("frame %s is left out: %s", name, error)

    def _measure(self, name: str, truth: Annotations, found: Detections) -> CheckedFrame:
        needs_image = self.prior is not None and self.prior.needs_image
        frame = self.workspace.dataset.read(name, image=needs_image)
        objects = truth.select(~np.isnan(truth.boxes).any(axis=1))
        every = Detections(
            np.concatenate([objects.boxes, found.boxes]),
            np.concatenate([np.ones(len(objects)), found.scores]),
            np.concatenate([objects.categories, found.categories]),
        )
        shown = camera_of_boxes(every.boxes, frame.cameras) >= 0
        points = count_points_in_boxes(frame.points, every.boxes)
        share = self._shares(frame, every)
        n = len(objects)
        self.seen.append((shown[:n], shown[n:]))
        rectangles = rectangles_in_image(found.boxes, frame)
        neutral = match_to_ground_truth(found, truth, self._settings(), rectangles).neutral
        return CheckedFrame(
            name, objects, found, points[:n], points[n:], share[:n], share[n:], neutral == "",
            self._masks(frame, truth),
        )  # fmt: skip

    def _masks(self, frame: Frame, truth: Annotations) -> Proposals:
        """Return the objects that image masks and points propose, outside of DontCare regions."""
        if self.segmenter is None or not frame.cameras:
            return Proposals.empty()
        regions = truth.boxes_2d[truth.categories == DONT_CARE]
        return propose_objects(frame, self.segmenter, empty_boxes(), self.sizes, regions=regions)

    def _settings(self) -> MatchSettings:
        return MatchSettings(minimum_iou=dict.fromkeys(self.workspace.config.dataset.categories, 1))

    def _shares(self, frame: Frame, boxes: Detections) -> np.ndarray:
        """Return (n,) S/A; NaN for boxes that no camera shows, and for other categories."""
        shares = np.full(len(boxes), np.nan)
        known = np.isin(boxes.categories, self.workspace.config.dataset.categories)
        if self.prior is None or not frame.cameras or not known.any():
            return shares
        measured = self.prior.measure(frame, boxes.select(known))
        pixels = np.asarray(measured["box_pixels"], dtype=np.float64)
        inside = np.where(pixels > 0, pixels, np.nan)
        shares[known] = np.asarray(measured["mask_pixels"], dtype=np.float64) / inside
        return shares


def _within_coverage(
    frames: Sequence[CheckedFrame], seen: Sequence[tuple[np.ndarray, np.ndarray]]
) -> list[CheckedFrame]:
    """Return the frames; if all labels are in images, predictions outside them do not count."""
    labels = np.concatenate([np.zeros(0, dtype=bool), *(each for each, _ in seen)])
    if not labels.any() or not labels.all():
        return list(frames)
    return [
        replace(each, counted=each.counted & shown)
        for each, (_, shown) in zip(frames, seen, strict=True)
    ]


def _splits_to_check(workspace: Workspace, request: SuspectRequest) -> tuple[str, ...]:
    """Return the splits with frames, in the order of `SPLITS`, so that errors appear early."""
    for split in request.splits:
        if split not in SPLITS:
            raise ConfigError(
                f"--split {split}: use labeled, val or all; other frames have no labels to check"
            )
    if not 0 <= request.minimum <= 1:
        raise ConfigError(f"--minimum {request.minimum:g}: must be from 0 to 1")
    number, rounds = request.round_number, workspace.config.run.rounds
    if number is not None and number > rounds and recorded_config(workspace, number) is None:
        raise ConfigError(f"--round {number}: there is no such round; run.rounds is {rounds}")
    counts = {split: len(workspace.frames(split)) for split in SPLITS}
    found = tuple(split for split in SPLITS if split in request.splits and counts[split])
    if not found:
        raise WorkspaceError(
            f"there are no {' or '.join(request.splits)} frames, so there are no labels to check; "
            "give `curate init` some with --labeled or --val"
        )
    if is_trainable(workspace) and "labeled" in found:
        highest = counts["labeled"]
        if not 2 <= request.folds <= highest:
            if highest >= 2:
                raise ConfigError(
                    f"--folds {request.folds}: there are {highest} labeled frames; "
                    f"use 2 to {highest}"
                )
            advice = "use --split val" if counts["val"] else "label further frames"
            raise ConfigError(f"folds need 2 labeled frames, and there is only one; {advice}")
    return found


def _predict_folds(
    workspace: Workspace, folds: int, progress: Progress, record: Callable[[Report], None]
) -> Iterator[dict[str, Detections]]:
    """Yield the predictions of each fold's teacher on the frames that it has not seen."""
    for fold, done in trained_folds(workspace, folds, progress, record):
        yield _predict(fold, "val", 1, progress, done)


def _predict(
    workspace: Workspace,
    split: str,
    round_number: int | None,
    progress: Progress,
    done: Callable[[Report], None],
) -> dict[str, Detections]:
    """Return the predictions of a round's teacher by frame; frames that failed are left out."""
    plan = open_plan(workspace, round_number, split=split)
    stage = plan.graph.frames_stage("predict")
    check_inputs(plan, [stage], split)
    with open_executor(workspace) as executor:
        report = run_frames(plan, stage, executor, progress, split)
    done(report)
    failed = {frame for frame, _ in report.errors}
    keys = {name: key for name, key in workspace.frames(split).items() if name not in failed}
    stored = workspace.predictions(plan.context.number, list(keys.values()))
    return {name: stored[key] for name, key in keys.items()}


def _describe_teachers(workspace: Workspace, splits: Sequence[str], request: SuspectRequest) -> str:
    if not is_trainable(workspace):
        return (
            f"detector '{workspace.config.detector.name}' predicted these frames; the list is only "
            "as good as if it was not trained on them"
        )
    parts = {
        "labeled": f"{request.folds} teachers, each trained without its fold, predicted X_l",
        "val": "the round's teacher predicted val",
    }
    return "; ".join(parts[split] for split in splits)


def _box(frame: CheckedFrame, suspect: Suspect) -> np.ndarray:
    """Return (7,) the box of the label, or of the prediction or mask if the label is missing."""
    if suspect.label >= 0:
        return np.asarray(frame.truth.boxes[suspect.label])
    if suspect.prediction >= 0:
        return np.asarray(frame.found.boxes[suspect.prediction])
    return np.asarray(frame.masks.boxes[suspect.mask])
