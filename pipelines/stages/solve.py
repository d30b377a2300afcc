"""solve: the weight of every label under a policy, in closed form over the whole round."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from sqlalchemy import Connection

from curate.weighting.base import Evidence, Policy, Weights
from db import bulk, weight_index
from pipelines.assembly import open_policy
from pipelines.evidence import LabelKeys, read_evidence, read_memory, solved_fingerprint
from pipelines.progress import Progress
from pipelines.review.human_labels import refresh_matches
from pipelines.stage import Product, RoundContext, RoundJob, Settings
from pipelines.workspace import Workspace

TRUSTED = 0.5  # a label of a greater weight counts as trusted

# The last of some frames, and the columns of their weights.
_Block = tuple[int, dict[str, np.ndarray]]


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


def run(workspace: Workspace, job: RoundJob, _progress: Progress) -> Product:
    """The policy's weights of the round."""
    context, policy = job.context, job.policy
    opened = open_policy(workspace.config, policy)
    looks_back = context.number > 1 and remembers(opened)
    keys, evidence = read_evidence(
        workspace,
        context.number,
        job.frames,
        boxes=looks_back,
        columns=getattr(opened, "reads", None),
    )
    if looks_back:
        evidence = replace(evidence, memory=read_memory(workspace, context.number - 1, policy))
    weights = opened.weigh(evidence, context.age)
    counts = _counts(context.number, policy, keys, weights)
    weight_index.prepare(workspace.database, policy)

    def write(connection: Connection) -> None:
        with weight_index.replacing(connection, policy, len(keys)):
            _replace(connection, context.number, policy, _blocks(keys, weights, evidence))
        former = bulk.table("label_count").c
        mine = (former.round == context.number, former.policy == policy)
        connection.execute(former.policy.table.delete().where(*mine))
        bulk.insert(connection, "label_count", counts)
        refresh_matches(connection, context.number)
        bulk.refresh_statistics(connection)

    trusted, total = int((weights.v > 0).sum()), float(weights.v.sum())
    summary = f"{len(keys)} labels, {trusted} with weight > 0, their weights sum to {total:.1f}"
    dropped = int(weights.dropped.sum())
    summary = f"{summary}, {dropped} dropped" if dropped else summary
    # No other process changes predictions of a round that is being solved, see `db.claims`.
    return Product(summary, write, keys_known=True)


def remembers(policy: Policy) -> bool:
    """Whether a policy wants to know what it thought of the round before."""
    return bool(getattr(policy, "remembers", False))


def _memory_fingerprint(workspace: Workspace, context: RoundContext, policy: str) -> str | None:
    """What a policy that remembers has stored of the round before."""
    if context.number == 1 or not remembers(open_policy(workspace.config, policy)):
        return None
    return solved_fingerprint(workspace, context.number - 1, policy)


def _replace(
    connection: Connection, round_number: int, policy: str, blocks: Iterator[_Block]
) -> None:
    """Puts the weights of a policy in the place of its former ones.

    The former ones of some frames leave just before the new ones come: their pages are at hand
    then, and have room.
    """
    weight = bulk.table("weight")
    mine = [weight.c.round == round_number, weight.c.policy == policy]
    for last, columns in blocks:
        until = [weight.c.frame_id <= last]
        connection.execute(weight.delete().where(*mine, *until))
        bulk.insert_columns(
            connection, "weight", {"round": round_number, "policy": policy, **columns}
        )
        mine[2:] = [weight.c.frame_id > last]
    connection.execute(weight.delete().where(*mine))


def _blocks(keys: LabelKeys, weights: Weights, evidence: Evidence) -> Iterator[_Block]:
    """Whole frames at a time, in the order of their keys."""
    columns = (keys.frame_id, keys.k, weights.lambda_u, evidence.rho_det, weights.v)
    end = 0
    while end < len(keys):
        start, last = end, keys.frame_id[min(end + bulk.BLOCK_ROWS, len(keys)) - 1]
        end = int(np.searchsorted(keys.frame_id, last, side="right"))
        kept = ~weights.dropped[start:end]
        frame_id, k, age, rho, v = (column[start:end][kept] for column in columns)
        yield int(last), {"frame_id": frame_id, "k": k, "lambda_u": age, "rho_det": rho, "v": v}


def _counts(round_number: int, policy: str, keys: LabelKeys, weights: Weights) -> list[bulk.Row]:
    """The rows of `label_count`."""
    kept, size = ~weights.dropped, len(keys.category_names)
    category, v = keys.category[kept], weights.v[kept]
    columns = [
        np.bincount(category[chosen], minlength=size).tolist()
        for chosen in (slice(None), v > 0, v > TRUSTED)
    ]
    columns.append(np.bincount(category, weights=v, minlength=size).tolist())
    return [
        (round_number, policy, name, *row)
        for name, row in zip(keys.category_names, zip(*columns, strict=True), strict=True)
        if row[0]
    ]
