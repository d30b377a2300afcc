"""solve: the weight of every label under a policy, in closed form over the whole round."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from sqlalchemy import Connection

from curate.weighting.base import Evidence, Weights
from db import bulk, weight_index
from pipelines.assembly import open_policy
from pipelines.engine.progress import Progress
from pipelines.engine.stage import Product, RoundContext, RoundJob, Settings
from pipelines.labels.evidence import LabelKeys, read_evidence, read_memory, solved_fingerprint
from pipelines.labels.human_labels import refresh_matches
from pipelines.labels.sources import report_unused
from pipelines.workspace.workspace import Workspace

TRUSTED = 0.5  # a label of a greater weight counts as trusted


def settings(workspace: Workspace, context: RoundContext, policy: str) -> Settings:
    """What weights depend on beside the evidence."""
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
    }


def check(workspace: Workspace, policy: str) -> None:
    """Check that the policy can be made with its settings.

    Raises:
        ConfigError: if it cannot.
    """
    open_policy(workspace.config, policy)


def run(workspace: Workspace, job: RoundJob, _progress: Progress) -> Product:
    """The policy's weights of the round."""
    report_unused(workspace)
    context, policy = job.context, job.policy
    opened = open_policy(workspace.config, policy)
    looks_back = context.number > 1 and opened.remembers
    keys, evidence = read_evidence(
        workspace,
        context.number,
        job.frames,
        boxes=looks_back,
        columns=opened.reads,
    )
    if looks_back:
        evidence = replace(evidence, memory=read_memory(workspace, context.number - 1, policy))
    weights = opened.weigh(evidence, context.age)
    columns = _columns(keys, weights, evidence)
    counts = _counts(context.number, policy, keys, weights)
    weight_index.prepare(workspace.database, policy)

    def write(connection: Connection) -> None:
        with weight_index.replacing(connection, policy, len(keys)):
            _store(connection, context.number, policy, columns)
        former = bulk.table("label_count").c
        mine = (former.round == context.number, former.policy == policy)
        connection.execute(former.policy.table.delete().where(*mine))
        bulk.insert_rows(connection, "label_count", counts)
        refresh_matches(connection, context.number)
        bulk.refresh_statistics(connection)

    trusted, total = int((weights.v > 0).sum()), float(weights.v.sum())
    summary = f"{len(keys)} labels, {trusted} with weight > 0, their weights sum to {total:.1f}"
    dropped = int(weights.dropped.sum())
    summary = f"{summary}, {dropped} dropped" if dropped else summary
    # No other process changes predictions of a round that is being solved, see `db.claims`.
    return Product(summary, write, keys_known=True)


def _memory_fingerprint(workspace: Workspace, context: RoundContext, policy: str) -> str | None:
    """What a policy that remembers has stored of the round before."""
    if context.number == 1 or not open_policy(workspace.config, policy).remembers:
        return None
    return solved_fingerprint(workspace, context.number - 1, policy)


def _store(
    connection: Connection, round_number: int, policy: str, columns: Mapping[str, np.ndarray]
) -> None:
    """Puts the weights of a policy in the place of its former ones.

    Those of the same labels are changed where they are; a server makes a new row of each change.
    """
    mine = {"round": round_number, "policy": policy}
    if bulk.on_server(connection) or not bulk.update_columns(
        connection, "weight", mine, ("frame_id", "k"), columns
    ):
        _replace(connection, mine, columns)


def _replace(
    connection: Connection, mine: Mapping[str, Any], columns: Mapping[str, np.ndarray]
) -> None:
    """Deletes the former weights and inserts the new ones.

    The former ones of some frames leave just before the new ones come: their pages are at hand
    then, and have room.
    """
    weight = bulk.table("weight")
    former = [weight.c[name] == value for name, value in mine.items()]
    frame_id, end = columns["frame_id"], 0
    while end < len(frame_id):
        start, last = end, int(frame_id[min(end + bulk.BLOCK_ROWS, len(frame_id)) - 1])
        end = int(np.searchsorted(frame_id, last, side="right"))
        connection.execute(weight.delete().where(*former, weight.c.frame_id <= last))
        block = {name: values[start:end] for name, values in columns.items()}
        bulk.insert(connection, "weight", {**mine, **block})
        former[len(mine) :] = [weight.c.frame_id > last]
    connection.execute(weight.delete().where(*former))


def _columns(keys: LabelKeys, weights: Weights, evidence: Evidence) -> dict[str, np.ndarray]:
    """The columns of `weight`, of the labels that are not dropped, by frame and k."""
    kept = ~weights.dropped if weights.dropped.any() else slice(None)
    return {
        "frame_id": keys.frame_id[kept],
        "k": keys.k[kept],
        "lambda_u": weights.lambda_u[kept],
        "rho_det": evidence.rho_det[kept],
        "v": weights.v[kept],
    }


def _counts(
    round_number: int, policy: str, keys: LabelKeys, weights: Weights
) -> list[dict[str, Any]]:
    """The rows of `label_count`."""
    kept, size = ~weights.dropped, len(keys.category_names)
    category, v = keys.category[kept], weights.v[kept]
    counts = {
        "labels": np.bincount(category, minlength=size),
        "kept": np.bincount(category[v > 0], minlength=size),
        "trusted": np.bincount(category[v > TRUSTED], minlength=size),
        "weight": np.bincount(category, weights=v, minlength=size),
    }
    return [
        {"round": round_number, "policy": policy, "category": name}
        | {column: values[i].item() for column, values in counts.items()}
        for i, name in enumerate(keys.category_names)
        if counts["labels"][i]
    ]
