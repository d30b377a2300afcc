"""solve: the weight of every label under a policy, in closed form over the whole round."""

from collections.abc import Sequence

import numpy as np
from sqlalchemy import Connection, Select, and_, select

from curate.weighting.base import Evidence, Weights
from db import bulk
from pipelines.assembly import open_policy
from pipelines.progress import Progress
from pipelines.registry import PRIORS
from pipelines.stage import Product, RoundContext, RoundJob, Settings
from pipelines.stages.score import table_of
from pipelines.workspace import Workspace


def settings(workspace: Workspace, context: RoundContext, policy: str) -> Settings:
    """What weights depend on beside the evidence."""
    section = workspace.config.solve
    return {
        "policy": policy,
        "scope": section.scope,
        "quantile": section.quantile,
        "options": section.options.get(policy, {}),
        "round": context.number,
        "rounds": context.rounds,
        "priors": workspace.config.run.priors,
    }


def run(workspace: Workspace, job: RoundJob, _progress: Progress) -> Product:
    """The policy's weights of the round."""
    context, policy = job.context, job.policy
    keys, evidence = read_evidence(workspace, context.number, job.frames)
    weights = open_policy(workspace.config, policy).weigh(evidence, context.age)
    rows = _rows(context.number, keys, policy, weights, evidence)
    weight = bulk.table("weight")

    def write(connection: Connection) -> None:
        mine = (weight.c.round == context.number, weight.c.policy == policy)
        connection.execute(weight.delete().where(*mine))
        bulk.insert(connection, "weight", rows)

    trusted, total = int((weights.v > 0).sum()), float(weights.v.sum())
    summary = f"{len(keys)} labels, {trusted} with weight > 0, their weights sum to {total:.1f}"
    return Product(summary, write)


def read_evidence(
    workspace: Workspace, round_number: int, frames: Sequence[int]
) -> tuple[list[tuple[int, int]], Evidence]:
    """The evidence of all labels of some frames, and their keys (frame_id, k)."""
    priors = workspace.config.run.priors
    wanted = set(frames)
    with workspace.database.reading() as connection:
        rows = bulk.select(connection, _evidence_query(round_number, priors))
    rows = [row for row in rows if row[0] in wanted]
    frame_index, k, category, score, loss, *rho = (
        zip(*rows, strict=True) if rows else [()] * (5 + len(priors))
    )
    return list(zip(frame_index, k, strict=True)), Evidence(
        frame_index=np.array(frame_index, dtype=np.int64),
        category=np.array(category, dtype=np.str_),
        score=np.array(score, dtype=np.float64),
        loss=np.array(loss, dtype=np.float64),
        rho={
            PRIORS.load(prior).rho_column: np.array(column, dtype=np.float64)
            for prior, column in zip(priors, rho, strict=True)
        },
    )


def _evidence_query(round_number: int, priors: Sequence[str]) -> Select[tuple[object, ...]]:
    prediction, consistency = bulk.table("prediction"), bulk.table("consistency")
    tables = [bulk.table(table_of(prior)) for prior in priors]
    source = prediction
    for table in (consistency, *tables):
        same = and_(*(table.c[key] == prediction.c[key] for key in ("round", "frame_id", "k")))
        source = source.outerjoin(table, same)  # type: ignore[assignment]
    columns = [prediction.c.frame_id, prediction.c.k, prediction.c.category, prediction.c.score]
    rho = [
        table.c[PRIORS.load(prior).rho_column] for prior, table in zip(priors, tables, strict=True)
    ]
    return (
        select(*columns, consistency.c.loss, *rho)
        .select_from(source)
        .where(prediction.c.round == round_number)
        .order_by(prediction.c.frame_id, prediction.c.k)
    )


def _rows(
    round_number: int,
    keys: Sequence[tuple[int, int]],
    policy: str,
    weights: Weights,
    evidence: Evidence,
) -> list[bulk.Row]:
    ages = np.where(np.isnan(weights.lambda_u), None, weights.lambda_u).tolist()  # type: ignore[call-overload]
    return [
        (round_number, frame_id, k, policy, age, rho, v)
        for (frame_id, k), age, rho, v in zip(
            keys, ages, evidence.rho_det.tolist(), weights.v.tolist(), strict=True
        )
    ]
