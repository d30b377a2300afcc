"""Explain one weight: list the numbers that it depends on, and recompute it from them."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from sqlalchemy import Select, and_, func, select, text

from curate.detections import Detections
from curate.errors import WorkspaceError
from curate.priors.base import EvidenceSource
from curate.weighting.base import Age, Evidence
from curate.weighting.self_paced import age_parameter, easiness
from db import bulk
from db.models import BOX_COLUMNS
from db.views import weighted_labels
from pipelines.assembly import (
    describe_score,
    open_prior,
    open_sequence_source,
    score_meaning,
)
from pipelines.labels.by_frame import check_weights, not_weighted_error, weighted_round
from pipelines.labels.sources import Source, sources_of
from pipelines.registry import PRIORS
from pipelines.reports.probability import (
    ExplainedProbability,
    explain_probability,
    fallback_line,
    probability_lines,
    rule_of,
)
from pipelines.review.decisions import describe_decision
from pipelines.stages.methods import ZERO_WEIGHT_WORDS, zero_weight_of
from pipelines.workspace.config import Config, make_config
from pipelines.workspace.workspace import Workspace


@dataclass(frozen=True)
class View:
    """The reprediction of a label in one augmented copy; scores and losses are None without one."""

    view: int
    flip_y: bool
    rotation_rad: float
    scale: float
    score: float | None
    iou: float | None
    score_loss: float | None
    box_loss: float | None


@dataclass(frozen=True)
class AgeParameter:
    """The terms of Eq. 4: lambda = (e/E) hardest + (1 - e/E) mean, at most the maximum.

    Attributes:
        round: e.
        rounds: E.
        scope: the labels that share this lambda: "round", "category" or "frame".
        matched: number of their losses.
        hardest: maximum of the losses, or their configured quantile.
        mean: mean of the losses.
        lambda_u: lambda, recomputed from these values.
    """

    round: int
    rounds: int
    scope: str
    matched: int
    hardest: float
    mean: float
    lambda_u: float


@dataclass(frozen=True)
class Recomputed:
    """The values of a label, each recomputed from the values that it depends on.

    Attributes:
        loss: L; None without a matched reprediction.
        rho: trust by column of each prior; None if the prior has no evidence.
        rho_det: product of the priors.
    """

    loss: float | None
    rho: Mapping[str, float | None]
    rho_det: float


@dataclass(frozen=True)
class Explanation:
    """A row of `weighted_labels`, the numbers behind its weight, the weight again, and lines."""

    label: dict[str, Any]
    views: tuple[View, ...]
    age: AgeParameter | None
    evidence: Recomputed
    recomputed: float | None
    lines: tuple[str, ...]
    probability: ExplainedProbability | None = None

    def as_text(self) -> str:
        """Return the explanation as text."""
        return "\n".join(self.lines)


def explain_label(
    workspace: Workspace, frame: str, k: int, round_number: int | None, policy: str
) -> Explanation:
    """Explain the weight of label k of a frame.

    Raises:
        WorkspaceError: if the policy has not weighted this label in the round.
        DataError: if a weight of the frame is not in [0, 1].
    """
    label = _label(workspace, frame, k, round_number, policy)
    if label["provenance"] == "human":
        return _human(workspace, label)
    return _computed(workspace, label)


def _human(workspace: Workspace, label: dict[str, Any]) -> Explanation:
    """Explain a person's decision; for a rejected label also the weight that the policy gave it."""
    decision = describe_decision(workspace, label)
    if label["weight"] == 0 and decision.policy_weight is not None:
        computed = _computed(workspace, {**label, "weight": decision.policy_weight})
        # The weight that counts is the person's, in the last line.
        own = (line.replace("  weight       ", "  policy weight", 1) for line in computed.lines)
        return replace(computed, label=label, lines=(*own, decision.lines[0]))
    lines = (*_head(_numbers(label)), *decision.lines)
    no_evidence = Recomputed(None, {}, math.nan)
    return Explanation(label, (), None, no_evidence, None, lines)


def _computed(workspace: Workspace, label: dict[str, Any]) -> Explanation:
    """Explain a weight that a policy computed."""
    frame, k = label["frame"], label["k"]
    views = _views(workspace, label["round"], frame, k)
    config = _stored_config(workspace, label["round"])
    rule = rule_of(config, label)
    age = _age(workspace, config, label, rule) if label["lambda_u"] is not None else None
    evidence = _evidence(config, label, views)
    probability = explain_probability(workspace, config, label)
    priors_only = not views and not _self_paced(config, rule)
    recomputed = _weight(rule, evidence, age, priors_only=priors_only)
    if probability is not None:
        recomputed = probability.weight
    limit = _limit(workspace, config, label, recomputed, rule)
    lines = _evidence_lines(config, label, views, evidence)
    if probability is not None:
        lines += probability_lines(probability, config.dataset.categories, label["category"])
    elif rule != label["policy"]:
        lines.append(fallback_line(workspace, label))
    lines += _weight_lines(config, label, rule, age, evidence, recomputed, limit, probability)
    meaning = workspace.config.detector.score_meaning or score_meaning(config)
    lines.insert(1, f"  score          {describe_score(meaning)}")
    lines[3:3] = _fusion_lines(workspace, label)
    recomputed = recomputed if limit is None else limit
    return Explanation(label, views, age, evidence, recomputed, tuple(lines), probability)


def _label(
    workspace: Workspace, frame: str, k: int, round_number: int | None, policy: str
) -> dict[str, Any]:
    if round_number is None:
        round_number = weighted_round(workspace, policy)
    with workspace.database.reading() as connection:
        view = weighted_labels(connection)
        labels = view.c
        check_weights(connection, round_number or 1, policy, frame)
        key = {"round": round_number, "frame": frame, "k": k, "policy": policy}
        query = select(view).where(*(labels[name] == key[name] for name in key))
        row = connection.execute(query).fetchone()
    if row is None:
        if replaced := _replaced(workspace, frame, k, round_number or 1):
            raise replaced
        if weighted_round(workspace, policy, round_number or 1) is None:
            raise not_weighted_error(round_number or 1, policy)
        raise WorkspaceError(
            f"round {round_number or 1}: {policy} gave no weight to label {k} of frame {frame}; "
            "there is no such label, or the policy dropped it. The view weighted_labels lists all "
            "weighted labels, see `curate query --help`"
        )
    return dict(row._mapping)  # noqa: SLF001 - its public name


def _replaced(workspace: Workspace, frame: str, k: int, number: int) -> WorkspaceError | None:
    """Return the error for a prediction that an object of a person replaces; None for others."""
    match, frames = bulk.table("human_match"), bulk.table("frame")
    key = select(frames.c.id).where(frames.c.frame == frame).scalar_subquery()
    here = (match.c.round == number, match.c.frame_id == key)
    label = select(match.c.n).where(*here, match.c.k == k).scalar_subquery()
    leading = workspace.database.rows(
        select(match.c.k).where(*here, match.c.n == label, match.c.leads == 1)
    )
    if not leading:
        return None
    return WorkspaceError(
        f"round {number}: label {k} of frame {frame} is replaced by label {leading[0][0]}, which a "
        f"person decided; run `curate explain {frame} {leading[0][0]}`"
    )


def _stored_config(workspace: Workspace, round_number: int) -> Config:
    """Return the settings that the round was last run with; curate.toml may have changed since."""
    table = bulk.table("round")
    query = select(table.c.config).where(table.c.number == round_number)
    with workspace.database.reading() as connection:
        stored = connection.execute(query).scalar_one()
    return make_config(json.loads(stored), f"stored settings of round {round_number}")


def _views(workspace: Workspace, round_number: int, frame: str, k: int) -> tuple[View, ...]:
    query = text(
        """
        SELECT v.view, v.flip_y, v.rotation_rad, v.scale, r.score, r.iou, r.score_loss, r.box_loss
        FROM reprediction_view AS v JOIN frame AS f ON f.id = v.frame_id
        LEFT JOIN reprediction AS r ON r.round = v.round AND r.frame_id = v.frame_id
            AND r.view = v.view AND r.matched_k = :k
        WHERE v.round = :round AND f.frame = :frame ORDER BY v.view
        """
    )
    with workspace.database.reading() as connection:
        rows = connection.execute(query, {"round": round_number, "frame": frame, "k": k})
        return tuple(View(row[0], bool(row[1]), *row[2:]) for row in rows)


def _age(
    workspace: Workspace, config: Config, label: dict[str, Any], rule: str
) -> AgeParameter | None:
    """Return the terms of Eq. 4 over the losses that share the label's lambda; None without any."""
    scope, quantile = _schedule(config, rule)
    number = bulk.table("round")
    query = _losses(label, scope)
    rounds = select(number.c.rounds).where(number.c.number == label["round"])
    with workspace.database.reading() as connection:
        losses = np.array([row[0] for row in bulk.select(connection, query)])
        last = int(connection.execute(rounds).scalar_one())
    if not len(losses):
        return None
    hardest = float(losses.max() if quantile is None else np.quantile(losses, quantile))
    lambda_u = _lambda(losses, Age(label["round"], last), quantile)
    mean = float(losses.mean())
    return AgeParameter(label["round"], last, scope, len(losses), hardest, mean, lambda_u)


def _lambda(losses: np.ndarray, age: Age, quantile: float | None) -> float:
    """Return lambda by Eq. 4 for losses that share it."""
    zeros = np.zeros(len(losses))
    evidence = Evidence(zeros.astype(np.int64), zeros.astype(np.str_), score=zeros, loss=losses)
    return float(age_parameter(evidence, age, quantile=quantile)[0])


def _losses(label: dict[str, Any], scope: str) -> Select[tuple[float]]:
    """Return the query for the losses that share a label's lambda.

    It includes labels that people decided on, because the policy used their losses too.
    """
    weight, loss = bulk.table("weight"), bulk.table("consistency")
    frame, prediction = bulk.table("frame"), bulk.table("prediction")
    keys = ("round", "frame_id", "k")
    tables = weight.join(loss, and_(*(loss.c[key] == weight.c[key] for key in keys)))
    tables = tables.join(prediction, and_(*(prediction.c[key] == weight.c[key] for key in keys)))
    tables = tables.join(frame, frame.c.id == weight.c.frame_id)
    places = {"category": prediction.c.category, "frame": frame.c.frame}
    same = () if scope == "round" else (places[scope] == label[scope],)
    return select(loss.c.loss).select_from(tables).where(
        weight.c.round == label["round"], weight.c.policy == label["policy"],
        frame.c.split == "unlabeled", loss.c.loss.is_not(None), *same,
    )  # fmt: skip


def _schedule(config: Config, policy: str) -> tuple[str, float | None]:
    """Return the scope of a policy's lambda, and the quantile that replaces the maximum, if any."""
    section = config.solve
    options = section.options.get(policy, {})
    return options.get("scope", section.scope), options.get("quantile", section.quantile)


def _evidence(config: Config, label: dict[str, Any], views: tuple[View, ...]) -> Recomputed:
    """Recompute L from the views and the priors from their counts.

    The values of user-supplied priors are taken as stored.
    """
    weights = config.repredict.score_weight, config.repredict.box_weight
    losses = [
        weights[0] * view.score_loss + weights[1] * view.box_loss
        for view in views
        if view.score_loss is not None and view.box_loss is not None
    ]
    rho = {
        column: _recomputed_rho(config, source, label)
        for source in sources_of(config.run.priors)
        for column in [source.declaration.rho_column]
        if column is not None
    }
    product = math.prod(value for value in rho.values() if value is not None)
    loss = sum(losses) / len(losses) if losses else None
    return Recomputed(loss, rho, product)


def _recomputed_rho(config: Config, source: Source, label: dict[str, Any]) -> float | None:
    """Return the trust of a prior, recomputed from its measurements; as stored for user priors."""
    column = str(source.declaration.rho_column)
    stored: float | None = label.get(column)
    if stored is None or source.configured not in PRIORS.classes or source.of_sequences:
        return stored
    rated = _opened(config, source, label).rate(
        _detections(label),
        {name: np.array([label[name]]) for name in source.measured_columns},
    )
    return float(rated[column][0])


def _opened(config: Config, source: Source, label: dict[str, Any]) -> EvidenceSource:
    """Return the source for rating one label, with what is stored with it from X_l."""
    thresholds = {label["category"]: label["points_threshold"] or 1.0}
    reference = label.get("share_reference")
    references = {} if reference is None else {label["category"]: reference}
    return open_prior(config, source.configured, thresholds, references=references, measures=False)


def _detections(label: dict[str, Any]) -> Detections:
    """Return the label as the only detection of a frame."""
    box = [label[name] for name in BOX_COLUMNS]
    return Detections.from_rows([(label["category"], label["score"], *box, None)])


def _self_paced(config: Config, policy: str) -> bool:
    """Return whether the policy uses the consistency loss."""
    section = config.solve
    self_paced = section.options.get(policy, {}).get("self_paced", section.self_paced)
    return policy != "pspsl" or bool(self_paced)


def _weight(
    rule: str, evidence: Recomputed, age: AgeParameter | None, *, priors_only: bool
) -> float | None:
    """Return the weight by Eqs. 7 and 11; None for policies that do not use them.

    The weight is rho_det if the policy does not use lambda (solve.self_paced = false), or if there
    is no second pass (`priors_only`).
    """
    if rule not in {"spsl", "pspsl"}:
        return None
    if evidence.loss is None:
        return evidence.rho_det if priors_only else 0.0
    if age is None:
        return evidence.rho_det
    v = float(easiness(np.array([evidence.loss]), np.array([age.lambda_u]))[0])
    return v * (evidence.rho_det if rule == "pspsl" else 1.0)


def _limit(
    workspace: Workspace,
    config: Config,
    label: dict[str, Any],
    recomputed: float | None,
    rule: str,
) -> float | None:
    """Return the weight of the best label with image evidence, if it limits this label's weight."""
    applies = label["box_pixels"] == 0 and config.semantic.outside == "expected"
    if not applies or rule != "pspsl" or not recomputed:
        return None
    weight, prior = bulk.table("weight"), bulk.table("semantic_prior")
    same = and_(*(weight.c[key] == prior.c[key] for key in ("round", "frame_id", "k")))
    query = select(func.max(weight.c.v)).select_from(weight.join(prior, same)).where(
        weight.c.round == label["round"], weight.c.policy == label["policy"],
        prior.c.box_pixels > 0,
    )  # fmt: skip
    best = workspace.database.rows(query)[0][0]
    return float(best) if best and best < recomputed else None


def _evidence_lines(
    config: Config, label: dict[str, Any], views: tuple[View, ...], evidence: Recomputed
) -> list[str]:
    """Return the lines that show the evidence of a label."""
    number = _numbers(label)
    section = config.repredict
    lines = _head(number)
    lines += [f"  {_view_line(view)}" for view in views]
    lines.append(
        f"  consistency    L = {section.score_weight:g} (-ln s') + {section.box_weight:g} box loss"
        f", mean over matched views = {number['loss']}"
        if views
        else "  consistency    no second pass over augmented copies, so no L"
    )
    for source in sources_of(config.run.priors):
        if any(label.get(column.name) is not None for column in source.declaration.columns):
            description = _described(config, source, label, number)
            lines.append(f"  {source.declaration.name:<14} {description}")
    factors = [f"{name} {value:.4f}" for name, value in evidence.rho.items() if value is not None]
    lines.append(f"  priors         rho_det = {' * '.join(factors) or '1'} = {number['rho_det']}")
    return lines


def _weight_lines(
    config: Config,
    label: dict[str, Any],
    rule: str,
    age: AgeParameter | None,
    evidence: Recomputed,
    recomputed: float | None,
    limit: float | None,
    probability: ExplainedProbability | None,
) -> list[str]:
    """Return the lines that show how the weight follows from the evidence."""
    number = _numbers(label)
    lines = []
    if probability is None:
        lines.append(_age_line(config, rule, age, str(number["lambda_u"])))
    formulas = {"spsl": "1 - L / lambda, Eq. 7", "pspsl": "rho_det (1 - L / lambda), Eq. 11"}
    if label["lambda_u"] is None and not _self_paced(config, rule):
        formulas["pspsl"] = "rho_det, without the self-paced term"
    formula = formulas.get(rule, "see curate solve --help")
    if probability is not None and probability.formula:
        formula = probability.formula
    lines.append(f"  policy         {label['policy']}: v = {formula}")
    lines.append(f"  weight         {number['weight']}{_meaning(config, label)}")
    if recomputed is not None:
        working = "" if probability else _working(rule, evidence, age)
        lines.append(f"  recomputed     {working}{recomputed:.4f}")
        if limit is not None:
            lines.append(
                f"  limited        to {limit:.4f}, the weight of the best label with image evidence"
            )
            recomputed = limit
        if not math.isclose(recomputed, label["weight"], abs_tol=1e-6):
            lines.append(
                "  they differ: the settings have changed since; rerun `curate solve` to update "
                "the weights"
            )
    return lines


def _described(
    config: Config, source: Source, label: dict[str, Any], number: Mapping[str, Any]
) -> str:
    """Return a source's description of the label's columns."""
    if source.of_sequences:
        return open_sequence_source(config, source.configured).describe(number)
    return _opened(config, source, label).describe(number)


def _meaning(config: Config, label: dict[str, Any]) -> str:
    """Return the meaning of weight 0 for the student; empty for other weights."""
    if label["weight"] > 0:
        return ""
    return f" ({ZERO_WEIGHT_WORDS[zero_weight_of(config, label['policy'])]})"


def _numbers(label: dict[str, Any]) -> dict[str, Any]:
    """Return the columns of a label as printable values."""
    return {
        name: "none" if value is None else f"{value:.4f}" if isinstance(value, float) else value
        for name, value in label.items()
    }


def _head(number: dict[str, Any]) -> list[str]:
    """Return the lines that identify the label and its box."""
    return [
        "round {round}, frame {frame}, label {k}: {category}, score {score}".format(**number),
        f"  box            {_box_text(number)}",
    ]


def _fusion_lines(workspace: Workspace, label: dict[str, Any]) -> list[str]:
    """Return the lines with the detector's box of a label with a fused box; none for others."""
    fused, frame, prediction = map(bulk.table, ("fused_box", "frame", "prediction"))
    same = and_(*(fused.c[key] == prediction.c[key] for key in ("round", "frame_id", "k")))
    query = (
        select(fused.c.boxes, *(prediction.c[name] for name in BOX_COLUMNS))
        .select_from(fused.join(prediction, same).join(frame, frame.c.id == fused.c.frame_id))
        .where(
            fused.c.round == label["round"],
            frame.c.frame == label["frame"],
            fused.c.k == label["k"],
        )
    )
    found = workspace.database.rows(query)
    if not found:
        return []
    boxes, *box = found[0]
    if boxes == 1:
        return ["  fused          no view matched: the box is that of the detector"]
    mean = f"mean of {boxes} boxes, weighted by s^2: the detector's and those of {boxes - 1} views"
    return [
        f"  fused          {mean}; L below is that of the detector's box",
        f"  detector's box {_box_text(_numbers(dict(zip(BOX_COLUMNS, box, strict=True))))}",
    ]


def _box_text(number: Mapping[str, Any]) -> str:
    """Return a box as text."""
    return "x {x}  y {y}  z {z}  l {length}  w {width}  h {height}  yaw {yaw}".format(**number)


def _age_line(config: Config, policy: str, age: AgeParameter | None, stored: str) -> str:
    """Return the line with Eq. 4 and its values."""
    if age is None:
        return f"  age, Eq. 4     lambda = {stored}"
    _, quantile = _schedule(config, policy)
    hardest = "max(L)" if quantile is None else f"{quantile:g} quantile of L"
    return (
        f"  age, Eq. 4     lambda = (e/E) {hardest} + (1 - e/E) mean(L) = {age.round}/{age.rounds} "
        f"* {age.hardest:.4f} + {1 - age.round / age.rounds:.4f} * {age.mean:.4f} = {stored}, over "
        f"{age.matched} matched labels of the {age.scope}"
    )


def _working(rule: str, evidence: Recomputed, age: AgeParameter | None) -> str:
    """Return the equation of the weight with its values; empty if nothing is to be computed."""
    if age is None or evidence.loss is None:
        return ""
    if evidence.loss >= age.lambda_u > 0:
        return f"L {evidence.loss:.4f} is not below lambda {age.lambda_u:.4f}: "
    ease = f"1 - {evidence.loss:.4f} / {age.lambda_u:.4f}"
    return f"{evidence.rho_det:.4f} * ({ease}) = " if rule == "pspsl" else f"{ease} = "


def _view_line(view: View) -> str:
    augmentation = (
        f"view {view.view}: {'flipped, ' if view.flip_y else ''}"
        f"rotated {view.rotation_rad:+.3f} rad, scaled {view.scale:.3f}"
    )
    if view.score is None:
        return f"{augmentation}: no match"
    return (
        f"{augmentation}: matched with BEV IoU {view.iou:.3f}, s' {view.score:.4f}, -ln s' "
        f"{view.score_loss:.4f}, box loss {view.box_loss:.4f}"
    )
