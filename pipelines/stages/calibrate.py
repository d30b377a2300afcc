"""calibrate: learn the probability that a label is correct from frames with ground truth.

The teacher must not have been trained on these frames. They are set aside, were declared as unseen
by the user's detector, or are held out from X_l in folds, each with a teacher of its own.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
from sqlalchemy import Connection

from curate.calibration.features import LabelEvidence, mean_log_sizes
from curate.calibration.model import (
    FEWEST_FRAMES,
    Calibration,
    TooFewLabels,
    fit_calibration,
)
from curate.datasets.base import sequences_of
from curate.datasets.frame_names import FrameNames, match_frame_list
from curate.errors import ConfigError
from curate.evaluation.kitti_rules import relaxed
from curate.evaluation.reliability import (
    auroc,
    expected_calibration_error,
    match_to_ground_truth,
)
from curate.exporters.base import named
from db import bulk
from pipelines.assembly import open_policy
from pipelines.engine.progress import Progress
from pipelines.engine.rounds import is_pretrained, is_student_trained, is_trainable
from pipelines.engine.stage import (
    Product,
    RoundContext,
    RoundJob,
    Settings,
    TruthFrames,
    TruthSource,
)
from pipelines.labels.calibration import check_held_out, needs_calibration
from pipelines.labels.label_evidence import read_label_evidence
from pipelines.labels.matching import configured_overlaps, match_settings, rectangles_in_image
from pipelines.stages.fold_students import student_stage
from pipelines.workspace.config import Config
from pipelines.workspace.folds import existing_folds, open_folds, split_folds
from pipelines.workspace.workspace import Workspace

SourceName = Literal["calibration", "labeled", "folds"]

SET_ASIDE: SourceName = "calibration"
_PARTS = 5  # of the frames, each left out once for the figures
_HOW_TO_SET_ASIDE = "set frames aside with `curate init --calibration`"


def applies(workspace: Workspace, policy: str) -> bool:
    """Return whether a policy reads probabilities."""
    return needs_calibration(open_policy(workspace.config, policy))


def settings(workspace: Workspace, context: RoundContext, policy: str) -> Settings:
    """Return what the calibration depends on besides the labels and their evidence."""
    section = workspace.config.calibrate
    try:
        source: str = choose_source(workspace, context.number)
    except ConfigError:  # reported when the stage runs
        source = ""
    unseen = _unseen(workspace) if source in {"labeled", "folds"} else None
    return {
        "source": source,
        "folds": section.folds if source == "folds" else 0,
        "overlap": section.overlap,
        "thresholds": _overlaps(workspace.config),
        "categories": workspace.config.dataset.categories,
        "held_out": _reads_held_out(workspace, policy),
        "split_by": workspace.config.dataset.split_by,
        "seed": context.seed,
        **({} if unseen is None else {"unseen": sorted(unseen)}),
    }


def check_truth(workspace: Workspace, policy: str, rounds: Iterable[int]) -> None:
    """Check that there are frames to learn from in some rounds, and further ones for max_wrong.

    Raises:
        ConfigError: if there are none that the teacher has not seen, or too few.
    """
    check_held_out(workspace, policy)
    sources = [choose_source(workspace, number) for number in rounds]
    if "folds" in sources and len(workspace.frames("labeled")) >= FEWEST_FRAMES:
        split_folds(workspace, workspace.config.calibrate.folds, "calibrate.folds")
    if SET_ASIDE in sources and _reads_held_out(workspace, policy):
        frames = list(workspace.frames(SET_ASIDE))
        units = len(set(_units(workspace, frames)[1]))
        if units < 2 or len(frames) <= FEWEST_FRAMES:
            raise ConfigError(
                f"solve.learned.max_wrong: half of the frames set aside are for the fit, half for "
                f"the bound, and {len(frames)} frames in {units} sequences or single frames are "
                "too few; set more aside, or remove max_wrong"
            )


def choose_source(workspace: Workspace, number: int) -> SourceName:
    """Return the frames to learn from in a round, by `calibrate.source`.

    Raises:
        ConfigError: if the teacher of the round has seen them, or there are none.
    """
    requested = workspace.config.calibrate.source
    reasons = _obstacles(workspace, number)
    if requested == "auto":
        for name, reason in reasons.items():
            if not reason:
                return name
        reason = reasons["labeled" if not is_trainable(workspace) and number == 1 else "folds"]
        raise ConfigError(f"calibrate: {reason}, or {_HOW_TO_SET_ASIDE}")
    if reasons[requested]:
        raise ConfigError(f'calibrate.source = "{requested}": {reasons[requested]}')
    return requested


def _obstacles(workspace: Workspace, number: int) -> dict[SourceName, str]:
    """Return why each source cannot be used in a round; "" if it can."""
    config = workspace.config
    detector = f"detector '{config.detector.name}'"
    unseen = _unseen(workspace)
    declare = (
        f"{detector} may have been trained on the labeled frames, and from frames that it has "
        "seen, probabilities would be too high: declare those that it has not seen with "
        "detector.unseen"
    )
    set_aside = list(workspace.frames(SET_ASIDE))
    seen = [] if unseen is None or not _is_supplied(workspace) else sorted({*set_aside} - unseen)
    trained = number > 1 and is_student_trained(workspace)
    obstacles: dict[SourceName, str] = dict.fromkeys((SET_ASIDE, "labeled", "folds"), "")
    if not set_aside:
        obstacles[SET_ASIDE] = f"there are no such frames; {_HOW_TO_SET_ASIDE}"
    elif seen and config.detector.unseen != "labeled":
        obstacles[SET_ASIDE] = (
            f"{len(seen)} frames set aside are not in detector.unseen ({named(seen)})"
        )
    if not _is_supplied(workspace) or trained:
        obstacles["labeled"] = f"the teacher of round {number} is trained on them; use folds"
    elif unseen is None:
        obstacles["labeled"] = declare
    if not is_trainable(workspace):
        obstacles["folds"] = f"curate cannot train {detector} without the held-out frames"
    elif trained and config.train.command is not None:
        obstacles["folds"] = (
            f"the teacher of round {number} is trained by train.command, which curate does not run "
            "for folds"
        )
    elif _is_supplied(workspace) and unseen is None:
        obstacles["folds"] = declare
    return obstacles


def truth(
    workspace: Workspace, context: RoundContext, policy: str, *, create: bool
) -> Sequence[TruthSource]:
    """Return the frames to learn from, and those for max_wrong.

    There are none if too few frames have ground truth: then nothing needs to be trained.
    """
    source, folds = choose_source(workspace, context.number), workspace.config.calibrate.folds
    if len(workspace.frames("labeled" if source == "folds" else source)) < FEWEST_FRAMES:
        return ()
    if source == "folds":
        opened = (
            open_folds(workspace, folds, "calibrate.folds")
            if create
            else existing_folds(workspace, folds)
        )
        students = tuple(student_stage(workspace, each) for each in range(1, context.number))
        found = [
            TruthSource(fold, "val", f"{i}/{folds}", students) for i, fold in enumerate(opened, 1)
        ]
    else:
        found = [TruthSource(workspace, source, source)]
    if source != SET_ASIDE and _reads_held_out(workspace, policy):
        found.append(TruthSource(workspace, SET_ASIDE, SET_ASIDE))
    return found


def run(workspace: Workspace, job: RoundJob, _progress: Progress) -> Product:
    """Fit the calibration of the round, and keep labels that it has not used for max_wrong."""
    config, source = workspace.config, choose_source(workspace, job.context.number)
    parts = [_read(each, config) for each in job.truth]
    labels = [
        part for part, each in zip(parts, job.truth, strict=True) if _is_for_fit(source, each)
    ]
    fitted, held_out = _Labels.joined(labels), _Labels.joined(parts[len(labels) :])
    unseen = _unseen(workspace)
    if source != SET_ASIDE and unseen is not None:
        fitted = fitted.of_frames(unseen)
    unit = _units(workspace, fitted.frames)[0]
    if _reads_held_out(workspace, job.policy) and source == SET_ASIDE:
        fitted, held_out = _halves(fitted, np.random.default_rng(job.context.seed))
    row: dict[str, Any] = {
        "round": job.context.number,
        "source": source,
        "folds": config.calibrate.folds if source == "folds" else 0,
        "overlap": config.calibrate.overlap,
        "thresholds": config.calibrate.thresholds,
        "teacher": job.context.teacher.sha256,
        "frames": len(fitted.frames),
        "labels": int(fitted.counted.sum()),
        "neutral": int((~fitted.counted).sum()),
        "right_labels": int(fitted.correct.sum()),
        "unit": unit,
    }
    counts = "{labels} labels of {frames} frames, {right_labels} correct".format(**row)
    try:
        calibration = _fit(workspace, fitted)
    except TooFewLabels as error:
        row |= {"fallback": str(error), "held_out_frames": 0}
        return Product(f"{counts}; no fit: {error}", _writer(job, row, []))
    figures = _out_of_sample(workspace, fitted)
    row |= {"fit": calibration.as_json(), "held_out_frames": len(held_out.frames), **figures}
    summary = ", ".join((counts, *(f"{name} {value:.3f}" for name, value in figures.items())))
    if held_out.frames:
        summary += f"; {len(held_out.frames)} further frames for max_wrong"
    return Product(
        summary.replace("_", " "), _writer(job, row, list(_held_out_rows(calibration, held_out)))
    )


@dataclass(frozen=True)
class _Labels:
    """The n labels of some frames with ground truth.

    Attributes:
        frames: names of the frames, with or without labels.
        unit: the sequence of each frame, or the frame itself.
        evidence: the evidence of the labels.
        frame: (n,) index of the frame of each label.
        keys: (n, 2) key of its frame and k, in the workspace of its source.
        correct: (n,) bool.
        counted: (n,) bool, False for labels that are neither correct nor wrong.
    """

    frames: tuple[str, ...]
    unit: tuple[str, ...]
    evidence: LabelEvidence
    frame: np.ndarray
    keys: np.ndarray
    correct: np.ndarray
    counted: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the labels of all parts."""
        none = _no_evidence()
        starts = np.cumsum([0, *(len(part.frames) for part in parts)])[:-1].tolist()
        flags, numbers = np.zeros(0, dtype=bool), np.zeros(0, dtype=np.int64)
        return cls(
            tuple(name for part in parts for name in part.frames),
            tuple(name for part in parts for name in part.unit),
            _joined_evidence([part.evidence for part in parts]) if parts else none,
            np.concatenate([numbers, *(p.frame + s for p, s in zip(parts, starts, strict=True))]),
            np.concatenate([numbers.reshape(0, 2), *(part.keys for part in parts)]),
            np.concatenate([flags, *(part.correct for part in parts)]),
            np.concatenate([flags, *(part.counted for part in parts)]),
        )

    def of_frames(self, names: Iterable[str]) -> Self:
        """Return the labels of the frames among some names."""
        wanted = set(names)
        kept = [i for i, name in enumerate(self.frames) if name in wanted]
        rows = np.isin(self.frame, kept)
        return type(self)(
            tuple(self.frames[i] for i in kept),
            tuple(self.unit[i] for i in kept),
            self.evidence.select(rows),
            np.searchsorted(kept, self.frame[rows]),
            self.keys[rows],
            self.correct[rows],
            self.counted[rows],
        )


def _read(found: TruthFrames, config: Config) -> _Labels:
    """Return the labels of a source, compared with its ground truth."""
    workspace, number = found.source.workspace, found.context.number
    matching = match_settings(config, config.calibrate.overlap, _overlaps(config))
    names = {key: name for name, key in workspace.frames(found.source.split).items()}
    keys, evidence = read_label_evidence(workspace, number, found.frames)
    annotations = workspace.ground_truth(found.source.split)
    correct, counted = [np.zeros(0, dtype=bool)], [np.zeros(0, dtype=bool)]
    order = sorted(found.frames)  # as the labels
    for key, labels in workspace.predictions(number, order).items():
        frame = workspace.dataset.read(names[key], points=False)
        rectangles = rectangles_in_image(labels.boxes, frame)
        matches = match_to_ground_truth(labels, annotations[names[key]], matching, rectangles)
        correct.append(matches.correct)
        counted.append(matches.counted)
    frames = [names[key] for key in order]
    return _Labels(
        tuple(frames),
        tuple(_units(workspace, frames)[1]),
        evidence,
        np.searchsorted(order, keys.frame_id),
        np.stack([keys.frame_id, keys.k], axis=1),
        np.concatenate(correct),
        np.concatenate(counted),
    )


def _fit(workspace: Workspace, labels: _Labels) -> Calibration:
    objects = workspace.ground_truth("labeled").values()
    boxes = [np.zeros((0, 7)), *(each.boxes for each in objects)]
    names = [np.zeros(0, dtype=np.str_), *(each.categories for each in objects)]
    categories = workspace.config.dataset.categories
    sizes = mean_log_sizes(np.concatenate(names), np.concatenate(boxes))
    return fit_calibration(
        labels.evidence.select(labels.counted),
        labels.correct[labels.counted],
        labels.frame[labels.counted],
        categories=categories,
        sizes={name: size for name, size in sizes.items() if name in categories},
    )


def _out_of_sample(workspace: Workspace, labels: _Labels) -> dict[str, float]:
    """Return the figures of probabilities in frames that are left out, each once.

    None if the fits without them have too few labels.
    """
    units = sorted(set(labels.unit))
    part_of = {unit: i % _PARTS for i, unit in enumerate(units)}
    part = np.array([part_of[unit] for unit in labels.unit])[labels.frame]
    probability = np.full(len(part), np.nan)
    try:
        for each in range(_PARTS):
            rest = [
                f for f, u in zip(labels.frames, labels.unit, strict=True) if part_of[u] != each
            ]
            fit = _fit(workspace, labels.of_frames(rest))
            inside = part == each
            probability[inside] = fit.probability(labels.evidence.select(inside))
    except TooFewLabels:
        return {}
    p, correct = probability[labels.counted], labels.correct[labels.counted]
    return {
        "auroc": auroc(p, correct),
        "calibration_error": expected_calibration_error(p, correct),
    }


def _held_out_rows(calibration: Calibration, labels: _Labels) -> Iterable[dict[str, Any]]:
    probability = calibration.probability(labels.evidence)
    for i, (key, k) in enumerate(labels.keys.tolist()):
        yield {
            "frame_id": key,
            "k": k,
            "probability": float(probability[i]),
            "correct": int(labels.correct[i]) if labels.counted[i] else None,
            "unit": labels.unit[int(labels.frame[i])],
        }


def _writer(job: RoundJob, row: dict[str, Any], held_out: Sequence[dict[str, Any]]) -> Any:
    number = job.context.number
    empty = dict.fromkeys(("auroc", "calibration_error", "fit", "fallback"))

    def write(connection: Connection) -> None:
        task = bulk.table("task").c
        for name in ("calibration_label", "calibration"):
            table = bulk.table(name)
            connection.execute(table.delete().where(table.c.round == number))
        # There is one calibration per round, also if several policies read it.
        others = (task.round == number, task.stage == "calibrate", task.variant != job.policy)
        connection.execute(bulk.table("task").delete().where(*others))
        bulk.insert_rows(connection, "calibration", [empty | row])
        bulk.insert_rows(
            connection, "calibration_label", [{"round": number, **r} for r in held_out]
        )

    return write


def _halves(labels: _Labels, generator: np.random.Generator) -> tuple[_Labels, _Labels]:
    """Split the frames into two halves by whole units, at random."""
    sizes = {unit: labels.unit.count(unit) for unit in sorted(set(labels.unit))}
    halves: tuple[set[str], set[str]] = (set(), set())
    counts = [0, 0]
    for unit in generator.permutation(list(sizes)).tolist():
        smaller = int(counts[1] < counts[0])
        halves[smaller].add(unit)
        counts[smaller] += sizes[unit]
    one, other = (
        [f for f, unit in zip(labels.frames, labels.unit, strict=True) if unit in half]
        for half in halves
    )
    return labels.of_frames(one), labels.of_frames(other)


def _is_for_fit(source: SourceName, found: TruthFrames) -> bool:
    """Return whether frames are for the fit; those set aside may be for max_wrong alone."""
    return source == SET_ASIDE or found.source.title != SET_ASIDE


def _units(workspace: Workspace, frames: Sequence[str]) -> tuple[str, list[str]]:
    """Return what is exchangeable, "frame" or "sequence", and that of each frame."""
    by_sequence = workspace.config.dataset.split_by == "sequence"
    sequences = sequences_of(workspace.dataset, frames) if by_sequence else {}
    return "sequence" if sequences else "frame", [sequences.get(each, each) for each in frames]


def _reads_held_out(workspace: Workspace, policy: str) -> bool:
    return "p_value" in open_policy(workspace.config, policy).reads


def _is_supplied(workspace: Workspace) -> bool:
    """Return whether the user supplies the first teacher, which may have seen any frame."""
    return not is_pretrained(workspace)


def _unseen(workspace: Workspace) -> frozenset[str] | None:
    """Return the frames in `detector.unseen`; None if it is unset, or curate trains the teacher.

    Raises:
        ConfigError: if its file is missing, or lists an unknown frame or no labeled one.
    """
    unseen = workspace.config.detector.unseen
    if unseen is None or not _is_supplied(workspace):
        return None
    labeled = frozenset(workspace.frames("labeled"))
    if unseen == "labeled":
        return labeled
    frames = FrameNames.of_dataset(workspace.dataset)
    try:
        found = frozenset(match_frame_list(unseen, frames, error_type=ConfigError))
    except ConfigError as error:
        raise ConfigError(f"detector.unseen: {error}") from None
    return found


def _overlaps(config: Config) -> dict[str, float]:
    """Return the IoU threshold of each category by `calibrate.thresholds`."""
    overlaps = configured_overlaps(config)
    return overlaps if config.calibrate.thresholds == "kitti" else relaxed(overlaps)


def _no_evidence() -> LabelEvidence:
    missing = np.zeros(0)
    return LabelEvidence(
        np.zeros(0, dtype=np.str_), missing, missing, missing, missing, missing, np.zeros((0, 7))
    )


def _joined_evidence(parts: Sequence[LabelEvidence]) -> LabelEvidence:
    further = list(parts[0].further)
    columns = {
        name: np.concatenate([part.columns()[name] for part in parts])
        for name in parts[0].columns()
    }
    return LabelEvidence(
        **{name: column for name, column in columns.items() if name not in further},
        further={name: columns[name] for name in further},
    )
