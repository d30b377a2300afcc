"""Whether a policy has weighted the labels of a round, and with weights that can be."""

from sqlalchemy import BindParameter, Connection, bindparam, func, or_, select

from curate.errors import WorkspaceError
from curate.exporters.base import bad_weight
from db import bulk
from pipelines.workspace.workspace import Workspace


def weighted_round(workspace: Workspace, policy: str, number: int | None = None) -> int | None:
    """The round asked for, or the last one; None where the policy has weighted nothing in it."""
    weight = bulk.table("weight")
    query = select(func.max(weight.c.round)).where(weight.c.policy == policy)
    if number is not None:
        query = query.where(weight.c.round == number)
    with workspace.database.reading() as connection:
        found: int | None = connection.execute(query).scalar_one()
    return found


def unweighted(round_number: int, policy: str) -> WorkspaceError:
    """What is wrong where a policy has weighted nothing in a round."""
    return WorkspaceError(
        f"round {round_number} has no labels weighted by {policy}; "
        f"run `curate solve --round {round_number} --policy {policy}`"
    )


def check_weights(
    connection: Connection, round_number: int, policy: str, frame: str | None = None
) -> None:
    """Raise DataError if a weight of a round, or of one frame in it, is not in [0, 1].

    No policy makes one, but SQLite keeps whatever else writes into the table.
    """
    weight, frames = bulk.table("weight"), bulk.table("frame")
    # A value in the text of the query lets the policy's own index answer it.
    chosen: BindParameter[str] = bindparam("policy", policy, literal_execute=True)
    # Text and NaN are beyond 1, in the order of either database.
    impossible = or_(weight.c.v < 0, weight.c.v > 1, weight.c.v.is_(None))
    query = (
        select(frames.c.frame, weight.c.k, weight.c.v)
        .join(frames, frames.c.id == weight.c.frame_id)
        .where(weight.c.round == round_number, weight.c.policy == chosen, impossible)
        .limit(1)
    )
    if frame is not None:
        query = query.where(frames.c.frame == frame)
    for row in bulk.select(connection, query):
        raise bad_weight(*row)
