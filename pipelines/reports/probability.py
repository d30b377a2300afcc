"""Explain the probability of a label and the weight that follows from it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import select

from curate.calibration.conformal import benjamini_hochberg, p_values
from curate.calibration.features import features
from curate.calibration.model import TooFewLabels
from curate.calibration.sharpening import sharpen
from curate.errors import WorkspaceError
from curate.weighting.learned import Learned
from db import bulk
from pipelines.assembly import open_policy
from pipelines.labels.calibration import (
    FALLBACK,
    needs_calibration,
    read_calibration,
    read_held_out,
    unit_index,
)
from pipelines.labels.label_evidence import label_evidence_of
from pipelines.workspace.config import Config
from pipelines.workspace.workspace import Workspace

_WIDTH = 80
_LONGEST_NAME = 20


@dataclass(frozen=True)
class ExplainedProbability:
    """The probability of a label, recomputed from its evidence, and the weight by it.

    Attributes:
        probability: p.
        intercept: logit of a label with mean evidence.
        terms: what each feature adds to the logit.
        values: the features; None for missing evidence.
        weight: the weight of the policy learned; None for other policies.
        p_value: conformal p-value of the label, with `max_wrong`; else None.
        formula: how the weight follows, as text.
    """

    probability: float
    intercept: float
    terms: Mapping[str, float]
    values: Mapping[str, float | None]
    weight: float | None
    p_value: float | None
    formula: str


def rule_of(config: Config, label: Mapping[str, Any]) -> str:
    """Return the policy by which a label was weighted: the fallback in a round without a fit."""
    policy = str(label["policy"])
    fitted = label.get("probability") is not None
    return policy if fitted or not needs_calibration(open_policy(config, policy)) else FALLBACK


def fallback_line(workspace: Workspace, label: Mapping[str, Any]) -> str:
    """Return why a label with a policy that needs a calibration was weighted without one."""
    try:
        read_calibration(workspace, label["round"])
    except (TooFewLabels, WorkspaceError) as error:
        return f"  no calibration {error}; weighted as by {FALLBACK}"
    return (
        f"  no calibration when the weights were computed, so as by {FALLBACK}; rerun "
        "`curate solve` to update the weights"
    )


def explain_probability(
    workspace: Workspace, config: Config, label: Mapping[str, Any]
) -> ExplainedProbability | None:
    """Recompute the probability and the weight of a label; None if it has no probability.

    Args:
        workspace: the workspace.
        config: the settings that the round was run with.
        label: the row of `weighted_labels`.
    """
    if label.get("probability") is None:
        return None
    calibration = read_calibration(workspace, label["round"])
    evidence = label_evidence_of(config, label)
    x = features(evidence, calibration.categories, calibration.sizes, calibration.further)[0]
    names = calibration.features
    p = float(calibration.probability(evidence)[0])
    policy = open_policy(config, label["policy"])
    weight: float | None = None
    p_value: float | None = None
    formula = ""
    if isinstance(policy, Learned):
        weight, p_value, formula = _weight(workspace, label, policy, p)
    return ExplainedProbability(
        p,
        calibration.intercept,
        dict(zip(names, calibration.terms(evidence)[0].tolist(), strict=True)),
        {n: None if np.isnan(v) else float(v) for n, v in zip(names, x, strict=True)},
        weight,
        p_value,
        formula,
    )


def _weight(
    workspace: Workspace, label: Mapping[str, Any], policy: Learned, p: float
) -> tuple[float, float | None, str]:
    """Return the weight of a label with probability p, its p-value if it has one, and how."""
    frame_id, k, stored = _probabilities(workspace, label["round"], label["policy"])
    if policy.max_wrong is None:
        sharpening = sharpen(stored, policy.precision)
        weight = float(sharpening.weights(np.array([p]))[0])
        formula = (
            f"p^gamma = {p:.4f}^{sharpening.gamma:.4g}, gamma for a precision of "
            f"{policy.precision:g} over {len(stored)} labels"
        )
        return weight, None, formula
    held_out = read_held_out(workspace, label["round"])
    values = p_values(held_out, stored, unit_index(workspace, frame_id, held_out.unit))
    selected = benjamini_hochberg(values, policy.max_wrong)
    key = select(bulk.table("frame").c.id).where(bulk.table("frame").c.frame == label["frame"])
    here = (frame_id == workspace.database.rows(key)[0][0]) & (k == label["k"])
    own = float(values[here][0])
    greatest = values.max(where=selected, initial=0.0)
    relation = "is" if selected[here][0] else "is not"
    formula = (
        f"1 if selected, else 0: the p-value {own:.3g} {relation} within {greatest:.3g}, the "
        f"greatest of {selected.sum()} labels selected for max_wrong = {policy.max_wrong:g}, by "
        f"{len(held_out.wrong)} wrong labels of {held_out.units} held-out {held_out.unit}s"
    )
    return float(selected[here][0]), own, formula


def _probabilities(
    workspace: Workspace, number: int, policy: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the frame keys, k and probabilities of all labels that a policy has weighted."""
    weight = bulk.table("weight")
    query = select(weight.c.frame_id, weight.c.k, weight.c.probability).where(
        weight.c.round == number, weight.c.policy == policy
    )
    with workspace.database.reading() as connection:
        found = bulk.select_columns(connection, query)
    return found["frame_id"], found["k"], found["probability"]


def probability_lines(
    found: ExplainedProbability, categories: tuple[str, ...], category: str
) -> list[str]:
    """Return the lines that show the terms of the logit as bars, at most 80 columns wide.

    Args:
        found: the explanation.
        categories: the categories, each a feature; their terms are shown as one.
        category: that of the label.
    """
    terms = {name: term for name, term in found.terms.items() if name not in categories}
    shown = {name: found.values[name] for name in terms}
    cells = {name: "missing" if value is None else f"{value:.3f}" for name, value in shown.items()}
    terms["category"] = sum(term for name, term in found.terms.items() if name in categories)
    cells["category"] = category[:8]
    terms = {"mean label": found.intercept, **terms}
    cells["mean label"] = ""
    logit = found.intercept + sum(found.terms.values())
    lines = [f"  probability    p = {found.probability:.4f} = 1 / (1 + exp(-logit)), the sum of:"]
    width = min(max(map(len, terms)), _LONGEST_NAME)
    # Two spaces at the left, two after the name, one before the term and the bars each.
    half = (_WIDTH - (4 + width + 2 + 8 + 1 + 8 + 2 + 1)) // 2
    scale = half / max(1.0, *map(abs, terms.values()))
    for name, term in terms.items():
        length = round(abs(term) * scale)
        left, right = ("-" * length, "") if term < 0 else ("", "+" * length)
        row = f"{name[:width]:<{width}}  {cells[name]:>8} {term:+8.3f}  {left:>{half}}|{right}"
        lines.append(f"    {row}")
    lines.append(f"    {'logit':<{width}}  {'':>8} {logit:+8.3f}")
    return lines
