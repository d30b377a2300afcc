"""The index by value that each policy's weights have."""

import sqlite3
from pathlib import Path

import pytest
from sqlalchemy import Connection, inspect, select
from support.older_schema import downgrade
from support.one_frame import add_one_frame
from support.stored_tuples import store

from db import bulk, weight_index
from db.session import Database
from db.views import drop_views

ENGINES = ("sqlite", "postgresql")
POLICIES = ("pspsl", "my.curation:Policy", "My.curation:Policy", 'it\'s "quoted"', "x" * 300)


@pytest.fixture
def database(database: Database) -> Database:
    """Return a database with weights of several policies."""
    with database.writing() as connection:
        add_one_frame(connection)
        rows = [(1, 1, k, "Car", 0.5, *[1.0] * 7, None) for k in range(20)]
        store(connection, "prediction", rows)
        for policy in POLICIES:
            _weigh(connection, policy)
    return database


def _weigh(connection: Connection, policy: str) -> None:
    store(connection, "weight", [(1, 1, k, policy, None, 1.0, k / 20) for k in range(20)])
    store(connection, "label_count", [(1, policy, "Car", 20, 19, 9, 9.5)])


def _indices(database: Database) -> set[str]:
    with database.reading() as connection:
        found = inspect(connection).get_indexes("weight")
    return {str(each["name"]) for each in found}


def test_every_policy_gets_one_index_for_any_name(database: Database) -> None:
    """Also for a user-supplied class; a second call changes nothing."""
    for policy in (*POLICIES, *POLICIES):
        weight_index.ensure_index(database, policy)
    expected = {str(weight_index.index_of(policy).name) for policy in POLICIES}
    assert len(expected) == len(POLICIES)
    assert {name.lower() for name in expected} == {name.lower() for name in _indices(database)}


@pytest.mark.parametrize("policy", POLICIES)
def test_a_query_for_a_policy_uses_its_index(tmp_path: Path, policy: str) -> None:
    """Whether the policy is in the query or a parameter."""
    database = Database(f"sqlite:///{tmp_path / 'curate.db'}")
    weight_index.ensure_index(database, policy)
    weight = bulk.table("weight").c
    query = select(weight.v).where(weight.round == 1, weight.policy == policy, weight.v > 0.5)
    name = weight_index.index_of(policy).name
    literal = query.compile(database.engine, compile_kwargs={"literal_binds": True})
    with sqlite3.connect(tmp_path / "curate.db") as raw:
        (plan,) = raw.execute(f"EXPLAIN QUERY PLAN {literal}")
        assert f"{name} (round=? AND v>?)" in plan[3]
        explain = "EXPLAIN QUERY PLAN SELECT v FROM weight WHERE round = ? AND policy = ? AND v > ?"
        (plan,) = raw.execute(explain, (1, policy, 0.5))
        assert f"{name} (round=? AND v>?)" in plan[3]


def test_only_the_index_of_the_policy_is_rebuilt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is dropped while its weights are replaced, that of another stays; then both exist."""
    monkeypatch.setattr(weight_index, "REBUILT_FROM", 1)
    database = Database(f"sqlite:///{tmp_path / 'curate.db'}")
    for policy in ("pspsl", "spsl"):
        weight_index.ensure_index(database, policy)
    with database.writing() as connection:
        with weight_index.rebuilding(connection, "spsl", 20):
            within = {str(each["name"]) for each in inspect(connection).get_indexes("weight")}
        assert within == {"ix_weight_v_pspsl"}
    assert _indices(database) == {"ix_weight_v_pspsl", "ix_weight_v_spsl"}


def test_weights_of_an_older_schema_get_their_indices(database: Database) -> None:
    """The downgrade leaves the single index of that schema."""
    weight_index.ensure_index(database, "pspsl")
    with database.writing(keys_known=True) as connection:
        drop_views(connection)
        downgrade(connection, "0007")
    database.close()
    assert _indices(database) == {"ix_weight_policy_v"}
    Database(database.url).close()
    assert len(_indices(database)) == len(POLICIES)
