"""Partial indexes of the table `weight`: one per policy, by round and weight.

A query for the labels of a policy with a weight in some range reads only those rows. One index
over all policies would do that too, but then every solve would change an index that holds the
weights of all other policies. Example with the policies pspsl and st3d:

    CREATE INDEX ix_weight_v_pspsl ON weight (round, v) WHERE policy = 'pspsl'
    CREATE INDEX ix_weight_v_st3d  ON weight (round, v) WHERE policy = 'st3d'

    SELECT * FROM weighted_labels WHERE policy = 'pspsl' AND round = 2 AND weight > 0.9

The query uses the first index. A solve of pspsl deletes and inserts entries of the first index
only. With many rows, SQLite is faster if the index is dropped before and created after (see
`rebuilding`): then its entries are sorted once, instead of a search in the index for each row.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256

from sqlalchemy import Connection, Index, MetaData, func, inspect, select
from sqlalchemy.schema import CreateIndex, DropIndex

from db import bulk
from db.claims import wait_for_transactions
from db.session import Database

PREFIX = "ix_weight_v_"
_BULK_CACHE_KIB = 64 * 1024

# Rebuilding an index costs, per row, a sixth of a deletion and an insertion, measured with 10
# million rows.
REBUILT_FROM = 100_000
_REBUILT_SHARE = 1 / 5
# PostgreSQL cuts names at 63 bytes, and SQLite ignores the case of an index name. The name of any
# other policy is hashed.
_PLAIN = re.compile(r"[a-z0-9_]{1,40}")
# Two processes may create the index of one policy at the same time; this lock makes one wait.
_LOCK = 0x776569676874  # "weight" in ASCII


def index_of(policy: str) -> Index:
    """Return the index of a policy's weights, by round and value."""
    plain = _PLAIN.fullmatch(policy)
    name = policy if plain else sha256(policy.encode()).hexdigest()[:32]
    # A copy of the table: SQLAlchemy would add the index to the table of the models.
    weight = bulk.table("weight").to_metadata(MetaData())
    of_policy = weight.c.policy == policy
    return Index(
        PREFIX + name,
        weight.c.round,
        weight.c.v,
        sqlite_where=of_policy,
        postgresql_where=of_policy,
    )


def ensure_index(database: Database, policy: str) -> None:
    """Create the index of a policy if it is missing.

    Call it outside any transaction that writes weights: it uses a transaction of its own, and
    PostgreSQL makes that wait until all writers of the table have finished.
    """
    index = index_of(policy)
    with database.reading() as connection:
        if _exists(connection, index):
            return
    with database.writing() as connection:
        wait_for_transactions(connection, _LOCK)
        if not _exists(connection, index):
            connection.execute(CreateIndex(index))


@contextmanager
def rebuilding(connection: Connection, policy: str, count: int) -> Iterator[None]:
    """Rebuild the index of a policy around a block that inserts or replaces many of its weights.

    The index is dropped before the block and created after it, on SQLite only, and only if the
    weights are a large share of those that the policy has. On PostgreSQL dropping an index would
    lock the table for other processes.

    Args:
        connection: connection in the writing transaction.
        policy: name of the policy.
        count: number of weights that the block writes.
    """
    worthwhile = connection.dialect.name == "sqlite" and count >= REBUILT_FROM
    if worthwhile:
        counted = bulk.table("label_count").c
        stored = select(func.sum(counted.labels)).where(counted.policy == policy)
        worthwhile = count >= (connection.execute(stored).scalar_one() or 0) * _REBUILT_SHARE
    if not worthwhile:
        yield
        return
    index = index_of(policy)
    connection.execute(DropIndex(index))
    # A larger cache for the pages in use, and a second thread that helps to sort the index.
    usual = connection.exec_driver_sql("PRAGMA cache_size").scalar_one()
    connection.exec_driver_sql(f"PRAGMA cache_size = -{_BULK_CACHE_KIB}")
    connection.exec_driver_sql("PRAGMA threads = 1")
    try:
        yield
        connection.execute(CreateIndex(index))
    finally:
        connection.exec_driver_sql(f"PRAGMA cache_size = {usual}")
        connection.exec_driver_sql("PRAGMA threads = 0")


def _exists(connection: Connection, index: Index) -> bool:
    return index.name in {each["name"] for each in inspect(connection).get_indexes("weight")}
