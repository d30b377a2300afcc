"""Rank unlabeled frames by what a person's labels there would change, from the stored evidence."""

from dataclasses import dataclass, replace

import numpy as np
from sqlalchemy import func, select

from curate.datasets.base import sequences_of
from curate.errors import ConfigError
from curate.review.next_frames import (
    FRAME_COST,
    CandidateLabels,
    Choice,
    FrameGains,
    choose_frames,
    frame_gains,
)
from curate.review.sheet import Sheet
from db import bulk
from pipelines.labels.by_frame import chosen_round, not_weighted_error, weighted_round
from pipelines.labels.columns import LabelColumns, read_columns
from pipelines.review.selection import ReviewRequest, make_sheet
from pipelines.workspace.workspace import Workspace


@dataclass(frozen=True)
class NextFrame:
    """An unlabeled frame that a person should label.

    Attributes:
        rank: 1 is the first.
        frame: name of the frame.
        sequence: its sequence; "" if the data set has none.
        boxes: expected number of objects to draw.
        change: expected change of the weights of its labels.
        error: expected squared error of the teacher's scores.
        doubtful: number of labels with an expected change of at least 0.25.
        gain: what the choice maximises, per box.
        reason: why it was chosen.
    """

    rank: int
    frame: str
    sequence: str
    boxes: float
    change: float
    error: float
    doubtful: int
    gain: float
    reason: str


@dataclass(frozen=True)
class NextFrames:
    """The chosen frames of a round.

    Attributes:
        round: the round of the labels.
        policy: the policy of the weights.
        candidates: number of frames to choose from.
        by_probability: whether p of the learned policy was stored; otherwise the weight was used.
        frames: the chosen frames in the order of their choice.
    """

    round: int
    policy: str
    candidates: int
    by_probability: bool
    frames: tuple[NextFrame, ...]


def rank_frames(
    workspace: Workspace,
    count: int,
    round_number: int | None = None,
    policy: str | None = None,
    frame_cost: float = FRAME_COST,
) -> NextFrames:
    """Choose frames to label next, see `curate.review.next_frames`.

    Frames for which people have decided about labels are left out.

    Args:
        workspace: see `Workspace`.
        count: number of frames.
        round_number: round of the labels; None for the last that the policy has weighted.
        policy: policy of the weights; None for the configured one.
        frame_cost: effort of a frame without boxes, in boxes.

    Raises:
        ConfigError: if fewer frames are left, or the cost is not above 0.
        WorkspaceError: if there are no predictions or no weights.
    """
    if not frame_cost > 0:
        raise ConfigError(f"--frame-cost {frame_cost:g}: must be above 0")
    policy = policy or workspace.config.run.method
    number = weighted_round(workspace, policy, round_number)
    if number is None:
        raise not_weighted_error(chosen_round(workspace, round_number), policy)
    decided = _decided(workspace)
    names = [name for name, key in workspace.frames("unlabeled").items() if key not in decided]
    if count > len(names):
        advice = f"use at most {len(names)}" if names else "there is nothing to choose"
        raise ConfigError(
            f"--frames {count}: {len(names)} unlabeled frames have no decision of a person yet; "
            f"{advice}"
        )
    found = read_columns(workspace, number, policy)
    labels, by_probability = _candidates(found, names)
    gains = frame_gains(labels, len(names), len(found.category_names))
    sequences = sequences_of(workspace.dataset, [*names, *workspace.frames("labeled")])
    of_labeled = [sequences[each] for each in workspace.frames("labeled") if each in sequences]
    choices = choose_frames(
        gains,
        count,
        _labeled_objects(workspace, found.category_names),
        [sequences.get(name, f"frame {name}") for name in names],
        of_labeled,
        frame_cost,
    )
    frames = tuple(
        _described(rank, choice, names[choice.frame], sequences.get(names[choice.frame], ""),
                   gains, found.category_names)
        for rank, choice in enumerate(choices, start=1)
    )  # fmt: skip
    return NextFrames(number, policy, len(names), by_probability, frames)


def next_sheet(workspace: Workspace, found: NextFrames, editor: str) -> Sheet:
    """Return a review of the chosen frames, in which their most uncertain labels are requested."""
    doubtful = sum(each.doubtful for each in found.frames)
    names = tuple(each.frame for each in found.frames)
    request = ReviewRequest(max(doubtful, 1), "uncertain", names)
    return make_sheet(workspace, found.round, found.policy, editor, request)


def _candidates(found: LabelColumns, names: list[str]) -> tuple[CandidateLabels, bool]:
    """Return the labels of the candidate frames, and whether their p is stored."""
    places = {name: place for place, name in enumerate(names)}
    of_frame = np.array([places.get(name, -1) for name in found.frame_names], dtype=np.int64)
    frame = of_frame[found.frames] if len(found) else np.zeros(0, dtype=np.int64)
    kept = frame >= 0
    weight, score = found.weights, found.numbers["score"]
    probability = found.numbers.get("probability", np.full(len(found), np.nan))
    known = ~np.isnan(probability)
    labels = CandidateLabels(
        frame, found.categories, score, weight, np.where(known, probability, weight)
    )
    columns = {name: column[kept] for name, column in vars(labels).items()}
    return replace(labels, **columns), bool(known[kept].any())


def _decided(workspace: Workspace) -> set[int]:
    """Return the keys of the frames with decisions of people."""
    rows = workspace.database.rows(select(bulk.table("human_label").c.frame_id).distinct())
    return {key for (key,) in rows}


def _labeled_objects(workspace: Workspace, categories: tuple[str, ...]) -> np.ndarray:
    """Return (c,) the number of objects of each category in X_l."""
    truth = bulk.table("ground_truth")
    query = (
        select(truth.c.category, func.count())
        .where(truth.c.split == "labeled")
        .group_by(truth.c.category)
    )
    counts: dict[str, int] = dict(workspace.database.rows(query))
    return np.array([counts.get(name, 0) for name in categories], dtype=np.float64)


def _described(
    rank: int,
    choice: Choice,
    name: str,
    sequence: str,
    gains: FrameGains,
    categories: tuple[str, ...],
) -> NextFrame:
    change, doubtful = gains.change[choice.frame], gains.doubtful[choice.frame]
    error = float(gains.error[choice.frame].sum())
    return NextFrame(
        rank=rank,
        frame=name,
        sequence=sequence,
        boxes=float(gains.boxes[choice.frame]),
        change=float(change.sum()),
        error=error,
        doubtful=int(doubtful.sum()),
        gain=choice.gain,
        reason=_reason(doubtful, float(change.sum()), error, choice, sequence, categories),
    )


def _reason(
    doubtful: np.ndarray,
    change: float,
    error: float,
    choice: Choice,
    sequence: str,
    categories: tuple[str, ...],
) -> str:
    order = np.argsort(-doubtful, kind="stable")
    counts = [f"{doubtful[c]} {categories[c]}" for c in order.tolist() if doubtful[c]]
    if counts:
        reason = f"doubtful: {', '.join(counts)}"
    elif change > error:
        reason = "many labels that are a little doubtful"
    elif error > 0:
        reason = "scores that the weights contradict"
    else:
        reason = "no labels to doubt"
    if sequence and not choice.of_sequence:
        return f"{reason}; the first of its sequence"
    if choice.of_sequence:
        return f"{reason}; counts 1/{choice.of_sequence + 1}, because of others of its sequence"
    return reason
