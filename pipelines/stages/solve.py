"""solve: the weight of every label under a policy, in closed form over the whole round."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from sqlalchemy import Connection, Select, and_, select

from curate.detections import as_categories, empty_boxes
from curate.errors import WorkspaceError
from curate.weighting.base import Evidence, Memory, Policy, Weights
from db import bulk
from db.models import BOX_COLUMNS
from pipelines.assembly import open_policy
from pipelines.progress import Progress
from pipelines.registry import PRIORS
from pipelines.review.human_labels import refresh_matches
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
    keys, evidence = read_evidence(workspace, context.number, job.frames, boxes=looks_back)
    if looks_back:
        evidence = replace(evidence, memory=read_memory(workspace, context.number - 1, policy))
    weights = opened.weigh(evidence, context.age)
    rows = _rows(context.number, keys, policy, weights, evidence)
    weight = bulk.table("weight")

    def write(connection: Connection) -> None:
        mine = (weight.c.round == context.number, weight.c.policy == policy)
        connection.execute(weight.delete().where(*mine))
        bulk.insert(connection, "weight", rows)
        refresh_matches(connection, context.number)

    trusted, total = int((weights.v > 0).sum()), float(weights.v.sum())
    summary = f"{len(keys)} labels, {trusted} with weight > 0, their weights sum to {total:.1f}"
    dropped = int(weights.dropped.sum())
    return Product(f"{summary}, {dropped} dropped" if dropped else summary, write)


def remembers(policy: Policy) -> bool:
    """Whether a policy wants to know what it thought of the round before."""
    return bool(getattr(policy, "remembers", False))


def read_memory(workspace: Workspace, round_number: int, policy: str) -> Memory:
    """The labels of a round that a policy has weighed and not dropped.

    Raises:
        WorkspaceError: the policy has not weighed that round.
    """
    weight, prediction = bulk.table("weight"), bulk.table("prediction")
    same = and_(*(weight.c[key] == prediction.c[key] for key in ("round", "frame_id", "k")))
    columns = [
        prediction.c[name] for name in ("frame_id", "category", "score", "iou", *BOX_COLUMNS)
    ]
    query = (
        select(*columns, weight.c.v)
        .select_from(weight.join(prediction, same))
        .where(weight.c.round == round_number, weight.c.policy == policy)
        .order_by(prediction.c.frame_id, prediction.c.k)
    )
    if solved_fingerprint(workspace, round_number, policy) is None:
        raise WorkspaceError(
            f"policy {policy} remembers round {round_number}, which it has not weighed; "
            f"run `curate solve --policy {policy} --round {round_number}`"
        )
    with workspace.database.reading() as connection:
        rows = bulk.select(connection, query)
    frame_index, category, *numbers = zip(*rows, strict=True) if rows else [()] * (5 + 7)
    score, iou, *boxes, v = (np.array(column, dtype=np.float64) for column in numbers)
    return Memory(
        frame_index=np.array(frame_index, dtype=np.int64),
        category=as_categories(category),
        score=score,
        iou=iou,
        boxes=np.stack(boxes, axis=1),
        v=v,
    )


def read_evidence(
    workspace: Workspace, round_number: int, frames: Sequence[int], *, boxes: bool = False
) -> tuple[list[tuple[int, int]], Evidence]:
    """The evidence of all labels of some frames, and their keys (frame_id, k).

    The boxes, which few policies look at, are read where they are asked for.
    """
    priors = workspace.config.run.priors
    wanted = set(frames)
    with workspace.database.reading() as connection:
        rows = bulk.select(connection, _evidence_query(round_number, priors, boxes=boxes))
    rows = [row for row in rows if row[0] in wanted]
    places = len(BOX_COLUMNS) if boxes else 0
    columns = zip(*rows, strict=True) if rows else [()] * (6 + len(priors) + places)
    frame_index, k, category, score, iou, loss, *more = columns
    rho, box = more[: len(priors)], more[len(priors) :]
    return list(zip(frame_index, k, strict=True)), Evidence(
        frame_index=np.array(frame_index, dtype=np.int64),
        category=np.array(category, dtype=np.str_),
        score=np.array(score, dtype=np.float64),
        loss=np.array(loss, dtype=np.float64),
        rho={
            PRIORS.load(prior).rho_column: np.array(column, dtype=np.float64)
            for prior, column in zip(priors, rho, strict=True)
        },
        iou=np.array(iou, dtype=np.float64),
        boxes=np.array(box, dtype=np.float64).T if boxes else empty_boxes(),
    )


def solved_fingerprint(workspace: Workspace, round_number: int, policy: str) -> str | None:
    """What the stored weights of a round and policy were made from; None where there are none."""
    task = bulk.table("task")
    mine = {"round": round_number, "stage": "solve", "variant": policy}
    query = select(task.c.fingerprint).where(*(task.c[name] == at for name, at in mine.items()))
    with workspace.database.reading() as connection:
        found = bulk.select(connection, query)
    return found[0][0] if found else None


def _memory_fingerprint(workspace: Workspace, context: RoundContext, policy: str) -> str | None:
    """What a policy that remembers has stored of the round before."""
    if context.number == 1 or not remembers(open_policy(workspace.config, policy)):
        return None
    return solved_fingerprint(workspace, context.number - 1, policy)


def _evidence_query(
    round_number: int, priors: Sequence[str], *, boxes: bool
) -> Select[tuple[object, ...]]:
    prediction, consistency = bulk.table("prediction"), bulk.table("consistency")
    tables = [bulk.table(table_of(prior)) for prior in priors]
    source = prediction
    for table in (consistency, *tables):
        same = and_(*(table.c[key] == prediction.c[key] for key in ("round", "frame_id", "k")))
        source = source.outerjoin(table, same)  # type: ignore[assignment]
    columns = [prediction.c[name] for name in ("frame_id", "k", "category", "score", "iou")]
    box = BOX_COLUMNS if boxes else ()
    rho = [
        table.c[PRIORS.load(prior).rho_column] for prior, table in zip(priors, tables, strict=True)
    ]
    return (
        select(*columns, consistency.c.loss, *rho, *(prediction.c[name] for name in box))
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
        for (frame_id, k), age, rho, v, dropped in zip(
            keys, ages, evidence.rho_det.tolist(), weights.v.tolist(), weights.dropped, strict=True
        )
        if not dropped
    ]
