"""Exports that would lose all labels, or all weighted labels of a category, are not written.

`.exports.json` in the workspace holds the number of weighted labels per category of each export, by
its path. An export is compared with the one of the same policy that it would replace. A category
that never had weighted labels is no loss.
"""

import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sqlalchemy import func, select

from curate.category_names import listed
from curate.errors import LabelsVanished
from curate.files.atomic import replace_file
from curate.review.human_labels import REJECTED
from db import bulk
from pipelines.assembly import open_policy
from pipelines.workspace.workspace import Workspace

_log = logging.getLogger(__name__)

RECORD = ".exports.json"


def check_labels(
    workspace: Workspace, round_number: int, policy: str, paths: Sequence[Path] = ()
) -> None:
    """Check that a round has labels, and that no category disappears from an export.

    Args:
        workspace: nothing is checked with its `allow_empty`.
        round_number: number e of the round.
        policy: policy of the weights; one that uses no unlabeled frames needs no labels.
        paths: the exports that would be replaced.

    Raises:
        LabelsVanished: if all labels or those of a category are gone.
    """
    unlabeled = workspace.frames("unlabeled")
    if not unlabeled or not open_policy(workspace.config, policy).uses_unlabeled:
        return
    labels, weighted = _counts(workspace, round_number, policy)
    lost = [] if labels else [f"round {round_number} has no label for policy {policy}"]
    if not labels:
        lost.append(_states(workspace, round_number, len(unlabeled)))
    for path in paths:
        former = _former(workspace, path, policy)
        gone = {name: count for name, count in former.items() if count and not weighted.get(name)}
        if gone:
            lost.append(
                f"{workspace.relative(path)} has weighted labels of {listed(gone)}, now there are "
                f"{listed(weighted) or 'none'}"
            )
            break
    if lost and not workspace.allow_empty:
        raise LabelsVanished(
            f"{'; '.join(lost)}; the former exports are kept: fix the cause, "
            "or write it all the same with --allow-empty"
        )
    if lost or not weighted:
        _log.warning("%s", "; ".join(lost) or "no label has a weight above 0")


def remember_labels(
    workspace: Workspace, round_number: int, policy: str, paths: Sequence[Path]
) -> None:
    """Record the labels of written exports, for the comparison with later ones."""
    _, weighted = _counts(workspace, round_number, policy)
    record = _record(workspace)
    record |= {workspace.relative(path): {"policy": policy, "labels": weighted} for path in paths}
    replace_file(workspace.root / RECORD, (json.dumps(record, indent=1) + "\n").encode())


def _former(workspace: Workspace, path: Path, policy: str) -> Mapping[str, int]:
    """Return the weighted labels of an existing export by category; empty for another policy."""
    entry = _record(workspace).get(workspace.relative(path), {})
    if not path.exists() or not isinstance(entry, dict) or entry.get("policy") != policy:
        return {}
    labels = entry.get("labels")
    return labels if isinstance(labels, dict) else {}


def _record(workspace: Workspace) -> dict[str, Any]:
    try:
        record = json.loads((workspace.root / RECORD).read_bytes())
    except (OSError, ValueError):  # missing, or damaged: then nothing is known of former exports
        return {}
    return record if isinstance(record, dict) else {}


def _counts(workspace: Workspace, round_number: int, policy: str) -> tuple[int, dict[str, int]]:
    """Return the number of labels, and the number with a weight above 0 by category.

    Labels of people are included; machine labels that people have replaced are not left out.
    """
    count, human = bulk.table("label_count").c, bulk.table("human_label").c
    machine = select(count.category, count.labels, count.kept).where(
        count.round == round_number, count.policy == policy
    )
    people = (
        select(human.category, func.count(), func.count())
        .where(human.from_round <= round_number, human.decision != REJECTED)
        .group_by(human.category)
    )
    labels, weighted = 0, dict[str, int]()
    for name, number, kept in (*workspace.database.rows(machine), *workspace.database.rows(people)):
        labels += number
        weighted[name] = weighted.get(name, 0) + kept
    return labels, {name: kept for name, kept in sorted(weighted.items()) if kept}


def _states(workspace: Workspace, round_number: int, frames: int) -> str:
    """Return how many frames each stage failed on, and in how many the detector found nothing."""
    task, frame = bulk.table("task"), bulk.table("frame")
    query = (
        select(task.c.stage, task.c.state, func.count())
        .join(frame, frame.c.id == task.c.frame_id)
        .where(task.c.round == round_number, frame.c.split == "unlabeled")
        .group_by(task.c.stage, task.c.state)
    )
    states = {(stage, state): count for stage, state, count in workspace.database.rows(query)}
    failed = [
        f"{count} failed in {stage}"
        for (stage, state), count in states.items()
        if state == "failed"
    ]
    empty = states.get(("predict", "empty"), 0)
    return (
        f"of {frames} unlabeled frames, {' and '.join(failed) or 'none failed'}"
        f"{' (`curate status --failed`)' * bool(failed)}, and {empty} have no box of "
        "dataset.categories above detector.minimum_score"
    )
