"""The calibration of a round: its fit, its held-out labels, and the probabilities that follow.

A policy that reads "probability" or "p_value" of the evidence needs a calibration. Without a usable
fit its labels are weighted as by the policy `FALLBACK`, and the summary of solve says so.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from sqlalchemy import select

from curate.calibration.conformal import HeldOut, Unit, p_values
from curate.calibration.model import Calibration, TooFewLabels
from curate.datasets.base import sequences_of
from curate.errors import ConfigError, WorkspaceError
from curate.weighting.base import Evidence, Policy
from db import bulk
from pipelines.assembly import open_policy
from pipelines.labels.evidence import LabelKeys
from pipelines.labels.label_evidence import read_label_evidence
from pipelines.workspace.workspace import Workspace

FALLBACK = "pspsl"
"""The policy that weights the labels of a round without a fit."""


def needs_calibration(policy: Policy) -> bool:
    """Return whether a policy reads what only a calibration gives."""
    return not {"probability", "p_value"}.isdisjoint(policy.reads)


def check_held_out(workspace: Workspace, policy: str) -> None:
    """Check that a policy with p-values has frames that nothing else uses.

    Raises:
        ConfigError: if it has none.
    """
    needed = "p_value" in open_policy(workspace.config, policy).reads
    if needed and not workspace.frames("calibration"):
        raise ConfigError(
            f"policy {policy}: max_wrong needs frames with ground truth that neither the teacher "
            "nor the fit uses; create the workspace with `curate init --calibration 0.2`"
        )


def open_usable_policy(workspace: Workspace, round_number: int, name: str) -> tuple[Policy, str]:
    """Return the policy that weights the labels of a round, and why it is another one, or "".

    Raises:
        WorkspaceError: if the policy needs a calibration, and the round has none yet.
    """
    policy = open_policy(workspace.config, name)
    if needs_calibration(policy):
        try:
            read_calibration(workspace, round_number)
        except TooFewLabels as error:
            bound = ", and max_wrong does not hold" if "p_value" in policy.reads else ""
            reason = f"weighted as by {FALLBACK}{bound}: {error}"
            return open_policy(workspace.config, FALLBACK), reason
    return policy, ""


def calibration_settings(workspace: Workspace, round_number: int, name: str) -> dict[str, Any]:
    """Return what the weights of a policy with a calibration depend on; nothing for others."""
    section = workspace.config.solve
    if not needs_calibration(open_policy(workspace.config, name)):
        return {}
    task = bulk.table("task")
    fitted = (task.c.round == round_number, task.c.stage == "calibrate")
    fingerprints = workspace.database.rows(select(task.c.fingerprint).where(*fitted))
    return {
        "learned": section.learned.model_dump(),
        "calibration": [row[0] for row in fingerprints],
        "fallback": section.options.get(FALLBACK, {}),
    }


def read_calibration(workspace: Workspace, round_number: int) -> Calibration:
    """Return the calibration of a round.

    Raises:
        TooFewLabels: if there were too few labels with truth to fit one.
        WorkspaceError: if the stage calibrate has not run in the round.
    """
    table = bulk.table("calibration")
    query = select(table.c.fit, table.c.fallback).where(table.c.round == round_number)
    found = workspace.database.rows(query)
    if not found:
        raise WorkspaceError(
            f"round {round_number} has no calibration; run `curate calibrate --round "
            f"{round_number}`"
        )
    fit, fallback = found[0]
    if fit is None:
        raise TooFewLabels(str(fallback))
    return Calibration.from_json(fit)


def read_held_out(workspace: Workspace, round_number: int) -> HeldOut:
    """Return the labels of a round with truth that neither its teacher nor its fit has used.

    Raises:
        ConfigError: if there are none.
    """
    label, calibration = bulk.table("calibration_label"), bulk.table("calibration")
    columns = (label.c.probability, label.c.correct, label.c.unit)
    rows = workspace.database.rows(select(*columns).where(label.c.round == round_number))
    units = select(calibration.c.unit).where(calibration.c.round == round_number)
    if not rows:
        raise ConfigError(
            f"round {round_number}: max_wrong needs labels with ground truth that neither the "
            "teacher nor the fit has used, and there are none; create the workspace with more "
            "frames for calibration, see `curate init --help`"
        )
    probability, correct, unit = zip(*rows, strict=True)
    return HeldOut.of_labels(
        workspace.database.rows(units)[0][0],
        np.unique(np.array(unit), return_inverse=True)[1],
        np.array(probability, dtype=np.float64),
        np.array([each == 0 for each in correct]),
    )


def with_estimates(
    workspace: Workspace,
    round_number: int,
    keys: LabelKeys,
    evidence: Evidence,
    reads: Sequence[str],
) -> Evidence:
    """Return the evidence with the probability of each label and, if it is read, its p-value.

    Args:
        workspace: the workspace.
        round_number: the round that made the labels.
        keys: the keys of all labels of some frames, sorted.
        evidence: the other evidence of these labels.
        reads: the columns that the policy reads.
    """
    calibration = read_calibration(workspace, round_number)
    frames = np.unique(keys.frame_id).tolist()
    _, labels = read_label_evidence(workspace, round_number, frames)
    probability = calibration.probability(labels)
    if "p_value" not in reads:
        return replace(evidence, probability=probability)
    held_out = read_held_out(workspace, round_number)
    units = unit_index(workspace, keys.frame_id, held_out.unit)
    p_value = p_values(held_out, probability, units)
    return replace(evidence, probability=probability, p_value=p_value)


def unit_index(workspace: Workspace, frame_id: np.ndarray, unit: Unit) -> np.ndarray:
    """Return (n,) the number of each label's frame, or of the sequence of its frame.

    A frame of unknown sequence is a sequence of its own.
    """
    if unit == "frame":
        return frame_id
    frame = bulk.table("frame")
    names: dict[int, str] = dict(workspace.database.rows(select(frame.c.id, frame.c.frame)))
    keys, place = np.unique(frame_id, return_inverse=True)
    sequences = sequences_of(workspace.dataset, [names[key] for key in keys.tolist()])
    units = [sequences.get(names[key], names[key]) for key in keys.tolist()]
    return np.asarray(np.unique(np.array(units, str), return_inverse=True)[1][place])
