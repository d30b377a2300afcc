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
    ("mine", "theirs", "word"),
    [
        ((1, None), (1, None), "round 1 is being worked on by predict"),
        ((1, None), (1, "pspsl"), "round 1 is being worked on by predict"),
        ((1, "pspsl"), (1, None), "round 1 is being worked on by predict"),
        ((1, "pspsl"), (1, "pspsl"), "round 1 of pspsl is being worked on by predict"),
    ],
)
def test_a_claimed_round_is_rejected_with_its_owner(
    pair: tuple[Database, Database], mine: tuple, theirs: tuple, word: str
) -> None:
    """One line: what, by whom, since when, what to do; afterwards it is free."""
    with pair[0].claiming_round(*mine, "predict"):
        with pytest.raises(DatabaseError) as refused, pair[1].claiming_round(*theirs, "solve"):
            pass
        message = str(refused.value)
        assert message.startswith(word)
        assert f"process {os.getpid()} on " in message
        assert ", since 2" in message
        assert "\n" not in message
    with pair[1].claiming_round(*theirs, "solve"):
        pass


@pytest.mark.parametrize(
    ("mine", "theirs"),
    [((1, None), (2, None)), ((1, "spsl"), (1, "pspsl")), ((1, "spsl"), (11, None))],
)
def test_independent_claims_are_granted_in_parallel(
    pair: tuple[Database, Database], mine: tuple, theirs: tuple
) -> None:
    """Different rounds, and the policies of one round."""
    with pair[0].claiming_round(*mine, "solve"), pair[1].claiming_round(*theirs, "solve"):
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
    mine, theirs = pair
    add = "INSERT INTO label_file (path, round, policy, sha256) VALUES ('{}', 1, 'p', '')"

    def lost_in_the_midst() -> None:
        with mine.claiming_round(1, None, "predict"):
            with mine.writing() as connection:
                connection.exec_driver_sql(add.format("before"))
            lose_claims(mine)
            with theirs.claiming_round(1, None, "solve"), mine.writing() as connection:
                connection.exec_driver_sql(add.format("after"))

    with pytest.raises(DatabaseError, match="finished frames are kept") as found:
        lost_in_the_midst()
    assert "\n" not in str(found.value)
    with theirs.claiming_round(1, None, "solve"), mine.writing() as connection:
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

    def lost_in_the_midst() -> None:
        with database.claiming_round(1, None, "predict"), database.writing() as connection:
            with other.writing() as ending:
                ending.exec_driver_sql(
                    "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
                    "WHERE pid <> pg_backend_pid() AND datname = current_database()"
                )
            connection.exec_driver_sql("SELECT 1")

    with pytest.raises(DatabaseError, match="check that the server runs") as found:
        lost_in_the_midst()
    assert "\n" not in str(found.value)
