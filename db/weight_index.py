"""An index of the weights by value for each policy, so that solving one touches no other's."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256

from sqlalchemy import Connection, Index, MetaData, func, inspect, select
from sqlalchemy.schema import CreateIndex, DropIndex

from db import bulk
from db.claims import one_at_a_time
from db.session import Database

PREFIX = "ix_weight_v_"
_BULK_CACHE_KIB = 64 * 1024

# Building an index anew costs a sixth of a row's way in and out of it, measured at 10 million rows.
REBUILT_FROM = 100_000
_REBUILT_SHARE = 1 / 5
# The longest name that PostgreSQL keeps has 63 letters; SQLite's index names ignore their case.
_PLAIN = re.compile(r"[a-z0-9_]{1,40}")
# Two processes may want the index of one policy at once; this number of theirs is one lock.
_LOCK = 0x776569676874  # "weight" in ASCII


def index_of(policy: str) -> Index:
    """Return the index of a policy's weights, by round and value."""
    named = _PLAIN.fullmatch(policy)
    name = policy if named else sha256(policy.encode()).hexdigest()[:32]
    # A copy of the table: an index joins the models of the one that it is made for.
    weight = bulk.table("weight").to_metadata(MetaData())
    mine = weight.c.policy == policy
    return Index(
        PREFIX + name, weight.c.round, weight.c.v, sqlite_where=mine, postgresql_where=mine
    )


def prepare(database: Database, policy: str) -> None:
    """See to it that a policy has its index.

    In a transaction of its own: a server waits for whoever is writing weights, who must not be the
    one that asks.
    """
    index = index_of(policy)
    with database.reading() as connection:
        if _exists(connection, index):
            return
    with database.writing() as connection:
        one_at_a_time(connection, _LOCK)
        if not _exists(connection, index):
            connection.execute(CreateIndex(index))


@contextmanager
def replacing(connection: Connection, policy: str, count: int) -> Iterator[None]:
    """Within it so many weights of a policy come, or leave and come again.

    Where they are a good part of all that it has, SQLite's index is made anew afterwards: row by
    row, each entry is a seek of its own. A server's table stays open to others.
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
    # Room for the pages in work, and a second core that sorts the index.
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
