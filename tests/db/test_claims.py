"""Claims: which processes can work on a round at the same time, with either engine."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from curate.errors import DatabaseError
from db.session import Database

ENGINES = ("sqlite", "postgresql")


@pytest.fixture
def pair(tmp_path: Path, new_url: Callable[[], str | None]) -> tuple[Database, Database]:
    """Return one database as two processes see it.

    A claim belongs to an open file or to a session.
    """
    url = new_url() or f"sqlite:///{tmp_path / 'curate.db'}"
    return Database(url), Database(url)


@pytest.mark.parametrize(
    ("first", "second", "word"),
    [
        ((1, None), (1, None), "round 1 is being worked on by predict"),
        ((1, None), (1, "pspsl"), "round 1 is being worked on by predict"),
        ((1, "pspsl"), (1, None), "round 1 is being worked on by predict"),
        ((1, "pspsl"), (1, "pspsl"), "round 1 of pspsl is being worked on by predict"),
    ],
)
def test_a_claimed_round_is_rejected_with_its_owner(
    pair: tuple[Database, Database], first: tuple, second: tuple, word: str
) -> None:
    """One line: what, by whom, since when, what to do; afterwards it is free."""
    with pair[0].claiming_round(*first, "predict"):
        with pytest.raises(DatabaseError) as rejected, pair[1].claiming_round(*second, "solve"):
            pass
        message = str(rejected.value)
        assert message.startswith(word)
        assert f"process {os.getpid()} on " in message
        assert ", since 2" in message
        assert "\n" not in message
    with pair[1].claiming_round(*second, "solve"):
        pass


@pytest.mark.parametrize(
    ("first", "second"),
    [((1, None), (2, None)), ((1, "spsl"), (1, "pspsl")), ((1, "spsl"), (11, None))],
)
def test_independent_claims_are_granted_in_parallel(
    pair: tuple[Database, Database], first: tuple, second: tuple
) -> None:
    """Different rounds, and the policies of one round."""
    with pair[0].claiming_round(*first, "solve"), pair[1].claiming_round(*second, "solve"):
        pass


def test_a_link_to_the_file_is_claimed_with_it(tmp_path: Path) -> None:
    """SQLite follows it, and so do claims."""
    database = Database(f"sqlite:///{tmp_path / 'curate.db'}")
    (tmp_path / "elsewhere").mkdir()
    linked = tmp_path / "elsewhere" / "curate.db"
    linked.symlink_to(tmp_path / "curate.db")
    with (
        database.claiming_round(1, None, "predict"),
        pytest.raises(DatabaseError, match="round 1 is being worked on by predict"),
        Database(f"sqlite:///{linked}").claiming_round(1, None, "predict"),
    ):
        pass


def test_an_error_ends_the_claim(pair: tuple[Database, Database]) -> None:
    """Any error while it was held."""
    with pytest.raises(ZeroDivisionError), pair[0].claiming_round(1, None, "predict"):
        raise ZeroDivisionError
    with pair[1].claiming_round(1, None, "predict"):
        pass


def lose_claims(database: Database) -> None:
    """End the session that holds the claims, or delete the locked files."""
    if database.engine.dialect.name == "sqlite":
        shutil.rmtree(f"{database.url.database}-locks")
        return
    with database.reading() as connection:
        ended = connection.exec_driver_sql(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid() "
            "AND datname = current_database() AND application_name LIKE 'predict, process%%'"
        ).scalars()
        assert list(ended) == [True]


def test_a_process_that_lost_its_claim_writes_nothing_more(pair: tuple[Database, Database]) -> None:
    """Another process may have claimed it; what was written before is kept."""
    first, second = pair
    add = "INSERT INTO label_file (path, round, policy, sha256) VALUES ('{}', 1, 'p', '')"

    def lose_the_claim() -> None:
        with first.claiming_round(1, None, "predict"):
            with first.writing() as connection:
                connection.exec_driver_sql(add.format("before"))
            lose_claims(first)
            with second.claiming_round(1, None, "solve"), first.writing() as connection:
                connection.exec_driver_sql(add.format("after"))

    with pytest.raises(DatabaseError, match="finished frames are kept") as found:
        lose_the_claim()
    assert "\n" not in str(found.value)
    with second.claiming_round(1, None, "solve"), first.writing() as connection:
        stored = connection.exec_driver_sql("SELECT path FROM label_file").scalars()
        assert list(stored) == ["before"]


def test_a_lost_server_gives_one_line(
    new_url: Callable[[], str | None],
) -> None:
    """The claim is lost as well; releasing it must not hide the original error."""
    url = new_url()
    if url is None:
        pytest.skip("a file is not lost like this")
    database, other = Database(url), Database(url)

    def lose_the_claim() -> None:
        with database.claiming_round(1, None, "predict"), database.writing() as connection:
            with other.writing() as ending:
                ending.exec_driver_sql(
                    "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
                    "WHERE pid <> pg_backend_pid() AND datname = current_database()"
                )
            connection.exec_driver_sql("SELECT 1")

    with pytest.raises(DatabaseError, match="check that the server runs") as found:
        lose_the_claim()
    assert "\n" not in str(found.value)
