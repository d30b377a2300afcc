"""The rounds with predictions and weights, and checks whether weights are in [0, 1]."""

from sqlalchemy import BindParameter, Connection, bindparam, func, or_, select

from curate.errors import WorkspaceError, error_prefix
from curate.exporters.base import bad_weight
from db import bulk
from pipelines.registry import POLICIES
from pipelines.workspace.workspace import Workspace


def chosen_round(workspace: Workspace, number: int | None) -> int:
    """Return the number of the given round, or of the last round with predictions.

    Raises:
        WorkspaceError: if the round, or every round, has no predictions.
    """
    table = bulk.table("prediction")
    query = select(func.max(table.c.round))
    if number is not None:
        query = query.where(table.c.round == number)
    with workspace.database.reading() as connection:
        found = connection.execute(query).scalar_one()
    if found is None:
        raise WorkspaceError(
            "no round has predictions yet; run `curate run` or `curate predict`"
            if number is None
            else f"round {number} has no predictions; run `curate predict --round {number}`"
        )
    return int(found)


def weighted_round(workspace: Workspace, policy: str, number: int | None = None) -> int | None:
    """Return the given round, or the last one with weights of a policy; None if it has none.

    Raises:
        ConfigError: if there are none, and no policy has this name.
    """
    weight = bulk.table("weight")
    query = select(func.max(weight.c.round)).where(weight.c.policy == policy)
    if number is not None:
        query = query.where(weight.c.round == number)
    with workspace.database.reading() as connection:
        found: int | None = connection.execute(query).scalar_one()
    if found is None:
        check_policy_name(policy)
    return found


def check_policy_name(policy: str) -> None:
    """Raise ConfigError if no policy has this name, which `curate solve` could not compute."""
    with error_prefix("--policy"):
        POLICIES.check_name(policy)


def not_weighted_error(round_number: int, policy: str) -> WorkspaceError:
    """Return the error for a round without weights of a policy.

    Raises:
        ConfigError: if no policy has this name.
    """
    check_policy_name(policy)
    return WorkspaceError(
        f"round {round_number} has no labels weighted by {policy}; "
        f"run `curate solve --round {round_number} --policy {policy}`"
    )


def check_weights(
    connection: Connection, round_number: int, policy: str, frame: str | None = None
) -> None:
    """Raise DataError if a weight of a round, or of one frame in it, is not in [0, 1].

    No policy returns such a weight, but another program can write it into an SQLite file.
    """
    weight, frames = bulk.table("weight"), bulk.table("frame")
    # The policy is written into the text of the query: with a parameter, SQLite could not use the
    # partial index of the policy.
    selected: BindParameter[str] = bindparam("policy", policy, literal_execute=True)
    # SQLite orders text after all numbers, and PostgreSQL orders NaN so: both are greater than 1.
    invalid = or_(weight.c.v < 0, weight.c.v > 1, weight.c.v.is_(None))
    query = (
        select(frames.c.frame, weight.c.k, weight.c.v)
        .join(frames, frames.c.id == weight.c.frame_id)
        .where(weight.c.round == round_number, weight.c.policy == selected, invalid)
        .limit(1)
    )
    if frame is not None:
        query = query.where(frames.c.frame == frame)
    for row in bulk.select(connection, query):
        raise bad_weight(*row)
