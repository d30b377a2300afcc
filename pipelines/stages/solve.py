"""solve: compute the weight of every label of a round under a policy, in closed form."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from sqlalchemy import Connection

from curate.weighting.base import Evidence, Weights
from db import bulk, weight_index
from pipelines.assembly import check_policy, open_policy
from pipelines.engine.progress import Progress
from pipelines.engine.stage import Product, RoundContext, RoundJob, Settings
from pipelines.labels.calibration import (
    calibration_settings,
    check_held_out,
    needs_calibration,
    open_usable_policy,
    with_estimates,
)
from pipelines.labels.evidence import LabelKeys, read_evidence, read_memory, solved_fingerprint
from pipelines.labels.human_labels import refresh_matches
from pipelines.labels.sources import prepare_probability, report_unused
from pipelines.workspace.workspace import Workspace

TRUSTED = 0.5  # labels with a greater weight count as trusted


def settings(workspace: Workspace, context: RoundContext, policy: str) -> Settings:
    """Return what the weights depend on besides the evidence."""
    section = workspace.config.solve
    return {
        "policy": policy,
        "scope": section.scope,
        "quantile": section.quantile,
        "self_paced": section.self_paced,
        "options": section.options.get(policy, {}),
        "round": context.number,
        "rounds": context.rounds,
        "priors": workspace.config.run.priors,
        "memory": _memory_fingerprint(workspace, context, policy),
        **calibration_settings(workspace, context.number, policy),
    }


def check(workspace: Workspace, policy: str) -> None:
    """Check that the policy can be created with its settings, and has the frames that it needs.

    Raises:
        ConfigError: if it cannot, or has not.
    """
    check_policy(workspace.config, policy)
    check_held_out(workspace, policy)


def run(workspace: Workspace, job: RoundJob, _progress: Progress) -> Product:
    """Compute the policy's weights of the round."""
    report_unused(workspace)
    context, policy = job.context, job.policy
    opened, reason = open_usable_policy(workspace, context.number, policy)
    needs_memory = context.number > 1 and opened.remembers
    keys, evidence = read_evidence(
        workspace,
        context.number,
        job.frames,
        boxes=needs_memory,
        columns=opened.reads,
    )
    if needs_calibration(opened):
        prepare_probability(workspace)
        evidence = with_estimates(workspace, context.number, keys, evidence, opened.reads)
    if needs_memory:
        evidence = replace(evidence, memory=read_memory(workspace, context.number - 1, policy))
    weights = opened.weigh(evidence, context.age)
    columns = _columns(keys, weights, evidence)
    counts = _counts(context.number, policy, keys, weights)
    weight_index.ensure_index(workspace.database, policy)

    def write(connection: Connection) -> None:
        with weight_index.rebuilding(connection, policy, len(keys)):
            _store(connection, context.number, policy, columns)
        count = bulk.table("label_count")
        former = (count.c.round == context.number, count.c.policy == policy)
        connection.execute(count.delete().where(*former))
        bulk.insert_rows(connection, "label_count", counts)
        refresh_matches(connection, context.number)
        bulk.refresh_statistics(connection)

    trusted, total = int((weights.v > 0).sum()), float(weights.v.sum())
    summary = f"{len(keys)} labels, {trusted} with weight > 0, their weights sum to {total:.1f}"
    dropped = int(weights.dropped.sum())
    summary = f"{summary}, {dropped} dropped" if dropped else summary
    summary = "; ".join(filter(None, (summary, weights.remark, reason)))
    # The keys need no check: the claim keeps other processes from changing the predictions.
    return Product(summary, write, keys_known=True)


def _memory_fingerprint(workspace: Workspace, context: RoundContext, policy: str) -> str | None:
    """Return the fingerprint of the weights that the policy reads from the round before."""
    if context.number == 1 or not open_policy(workspace.config, policy).remembers:
        return None
    return solved_fingerprint(workspace, context.number - 1, policy)


def _store(
    connection: Connection, round_number: int, policy: str, columns: Mapping[str, np.ndarray]
) -> None:
    """Replace the stored weights of a policy."""
    weight, key = bulk.table("weight"), {"round": round_number, "policy": policy}
    former = (weight.c[name] == value for name, value in key.items())
    connection.execute(weight.delete().where(*former))
    if len(columns["k"]):
        bulk.insert(connection, "weight", {**key, **columns})


def _columns(keys: LabelKeys, weights: Weights, evidence: Evidence) -> dict[str, np.ndarray]:
    """Return the columns of `weight` for the labels that are not dropped, by frame and k."""
    kept = ~weights.dropped if weights.dropped.any() else slice(None)
    return {
        "frame_id": keys.frame_id[kept],
        "k": keys.k[kept],
        "lambda_u": weights.lambda_u[kept],
        "rho_det": evidence.rho_det[kept],
        "v": weights.v[kept],
        "probability": evidence.probability[kept],
    }


def _counts(
    round_number: int, policy: str, keys: LabelKeys, weights: Weights
) -> list[dict[str, Any]]:
    """Return the rows of `label_count`."""
    kept = ~weights.dropped
    names, category = np.unique(keys.category[kept], return_inverse=True)
    v, size = weights.v[kept], len(names)
    counts = {
        "labels": np.bincount(category, minlength=size),
        "kept": np.bincount(category[v > 0], minlength=size),
        "trusted": np.bincount(category[v > TRUSTED], minlength=size),
        "weight": np.bincount(category, weights=v, minlength=size),
    }
    return [
        {"round": round_number, "policy": policy, "category": name}
        | {column: values[i].item() for column, values in counts.items()}
        for i, name in enumerate(names.tolist())
    ]
