"""The database: its schema, its constraints, and its error messages."""

import os
import shutil
import sqlite3
import subprocess
from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, inspect
from support.older_schema import downgrade
from support.paths import ROOT
from support.stored_tuples import COLUMNS, store

from curate.errors import DatabaseError, LeakageError
from curate.exporters.base import WEIGHTED_LABEL_COLUMNS
from db import bulk
from db.addresses import parse_url
from db.models import Base
from db.session import REVISIONS, Database
from db.views import drop_views

ENGINES = ("sqlite", "postgresql")


@pytest.fixture
def sqlite_database(tmp_path: Path) -> Database:
    """Return an empty SQLite database."""
    return Database(f"sqlite:///{tmp_path / 'curate.db'}")


def _frame(database: Database, split: str) -> int:
    with database.writing() as connection:
        store(connection, "frame", [("kitti", f"f-{split}", split, "p", "i", "c", None)])
        query = f"SELECT id FROM frame WHERE split = '{split}'"
        return connection.exec_driver_sql(query).scalar_one()


def _truth(frame_id: int, split: str) -> tuple:
    return (frame_id, 0, split, "Car", *[1.0] * 7, 0.0, 0, 0.0, *[1.0] * 4)


def test_migrations_create_the_tables_of_the_models(database: Database) -> None:
    """There is no difference between the migrated schema and the models."""
    with database.reading() as connection:
        difference = compare_metadata(MigrationContext.configure(connection), Base.metadata)
    assert difference == [], "make a migration: alembic -x url=... revision --autogenerate"


def test_a_database_of_an_older_curate_is_migrated(database: Database) -> None:
    """Its rows are kept, the new tables and views exist, and the downgrade restores it."""
    _frame(database, "val")
    with database.writing() as connection:
        drop_views(connection)
        downgrade(connection, "0001")
        assert "audit" not in inspect(connection).get_table_names()
    database.close()
    with Database(database.url).reading() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM frame").scalar_one() == 1
        for name in ("audit", "audit_slice", "audit_bin", "evaluation", "evaluation_ap"):
            assert connection.exec_driver_sql(f"SELECT count(*) FROM {name}").scalar_one() == 0


def test_an_older_database_is_copied_before_it_is_migrated(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The name of the copy contains its schema; a new database needs no copy."""
    url = f"sqlite:///{tmp_path / 'curate.db'}"
    database = Database(url)
    assert [path.name for path in tmp_path.glob("*backup*")] == []
    _frame(database, "val")
    with database.writing() as connection:
        downgrade(connection, "0001")
    database.close()
    Database(url).close()
    backup = tmp_path / "curate.db.schema-0001.backup"
    assert str(backup) in caplog.text
    with sqlite3.connect(backup) as old:
        assert old.execute("SELECT count(*) FROM frame").fetchone() == (1,)
        assert old.execute("SELECT version_num FROM alembic_version").fetchone() == ("0001",)
        tables = {row[0] for row in old.execute("SELECT name FROM sqlite_master")}
    assert "audit" not in tables


@pytest.fixture
def older_server_database(new_url: Callable[[], str | None]) -> Database:
    """Return a PostgreSQL database of the first schema, with one frame."""
    url = new_url()
    if url is None:
        pytest.skip("SQLite files are copied, see above")
    database = Database(url)
    _frame(database, "val")
    with database.writing() as connection:
        drop_views(connection)
        downgrade(connection, "0001")
    database.close()
    return database


@pytest.mark.skipif(shutil.which("pg_dump") is None, reason="pg_dump is not installed")
def test_an_older_server_database_is_dumped_before_it_is_migrated(
    older_server_database: Database, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Into the folder of the workspace; pg_restore reads it."""
    Database(older_server_database.url, tmp_path).close()
    backup = tmp_path / "curate.schema-0001.dump"
    assert str(backup) in caplog.text
    assert list(tmp_path.iterdir()) == [backup]
    listed = subprocess.run(
        ["pg_restore", "--file=-", backup], check=True, capture_output=True, text=True
    ).stdout
    assert "COPY public.frame" in listed
    assert "audit" not in listed


def test_a_server_database_that_cannot_be_dumped_is_not_migrated(
    older_server_database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """pg_dump fails: one line with its reason, and the schema does not change."""
    failing = tmp_path / "pg_dump"
    failing.write_text("#!/bin/sh\necho server version mismatch >&2\nexit 1\n")
    failing.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    remedy = r"cannot be copied.*version mismatch; install the pg_dump of the server"
    with pytest.raises(DatabaseError, match=remedy):
        Database(older_server_database.url, tmp_path)
    with older_server_database.engine.connect() as connection:
        found = connection.exec_driver_sql("SELECT version_num FROM alembic_version").scalar_one()
    assert found == "0001"


def test_a_server_without_pg_dump_is_migrated_with_a_warning(
    older_server_database: Database,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The migration is one transaction."""
    monkeypatch.setenv("PATH", str(tmp_path))
    Database(older_server_database.url, tmp_path).close()
    assert "without a backup" in caplog.text
    assert list(tmp_path.iterdir()) == []


def test_a_second_process_does_not_overwrite_the_copy(
    tmp_path: Path, new_url: Callable[[], str | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two processes find an older schema at once; the copy stays that of the older schema."""
    database = Database(new_url() or f"sqlite:///{tmp_path / 'curate.db'}")
    with database.writing() as connection:
        drop_views(connection)
        downgrade(connection, "0001")
    database.close()
    writing = Database.writing

    def late(self: Database, **options: bool) -> AbstractContextManager[Connection]:
        monkeypatch.setattr(Database, "writing", writing)
        Database(database.url, tmp_path).close()
        return self.writing(**options)

    monkeypatch.setattr(Database, "writing", late)
    made: list[str] = []
    monkeypatch.setattr("db.session.back_up", lambda _url, revision, _folder: made.append(revision))
    Database(database.url, tmp_path).close()
    assert made == ["0001"]


def test_a_password_anywhere_in_a_url_is_not_shown() -> None:
    """The server's library also accepts it in the query."""
    for address in (
        "postgresql://me:hidden@/name?host=/x",
        "postgresql://me@/name?password=hidden",
    ):
        url = parse_url(address)
        assert url.password == "hidden"  # noqa: S105
        assert "hidden" not in url.render_as_string()


def test_weighted_labels_has_exactly_the_columns_of_the_format(database: Database) -> None:
    """The view and the exported file agree on names and order."""
    with database.reading() as connection:
        cursor = connection.exec_driver_sql("SELECT * FROM weighted_labels")
        assert tuple(cursor.keys()) == WEIGHTED_LABEL_COLUMNS


@pytest.mark.parametrize("claimed", ["labeled", "unlabeled", "val"])
def test_ground_truth_of_an_unlabeled_frame_cannot_be_stored(
    database: Database, claimed: str
) -> None:
    """Whatever split the row claims, the frame's own split decides."""
    frame_id = _frame(database, "unlabeled")
    with pytest.raises((LeakageError, DatabaseError)), database.writing() as connection:
        store(connection, "ground_truth", [_truth(frame_id, claimed)])


def test_ground_truth_is_rejected_with_foreign_keys_switched_off(
    sqlite_database: Database, tmp_path: Path
) -> None:
    """The sqlite3 shell, which does not check foreign keys, cannot do it either."""
    frame_id = _frame(sqlite_database, "unlabeled")
    with sqlite3.connect(tmp_path / "curate.db") as raw:
        raw.execute("PRAGMA foreign_keys = OFF")
        marks = ", ".join("?" * len(COLUMNS["ground_truth"]))
        with pytest.raises(sqlite3.IntegrityError, match="unlabeled frame"):
            raw.execute(f"INSERT INTO ground_truth VALUES ({marks})", _truth(frame_id, "labeled"))


def test_a_labeled_frame_with_ground_truth_cannot_become_unlabeled(database: Database) -> None:
    """The key of the ground truth includes the split."""
    frame_id = _frame(database, "labeled")
    with database.writing() as connection:
        store(connection, "ground_truth", [_truth(frame_id, "labeled")])
    with pytest.raises(DatabaseError), database.writing() as connection:
        connection.exec_driver_sql("UPDATE frame SET split = 'unlabeled'")


def test_an_unlabeled_frame_has_no_label_path(database: Database) -> None:
    """Not even the path of a label file is stored for X_u."""
    row = ("kitti", "x", "unlabeled", "p", "i", "c", "label_2/x.txt")
    with pytest.raises(DatabaseError), database.writing() as connection:
        store(connection, "frame", [row])


def test_a_transaction_is_stored_completely_or_not_at_all(database: Database) -> None:
    """An error rolls back what the transaction had written."""
    with pytest.raises(ZeroDivisionError), database.writing() as connection:
        store(connection, "frame", [("kitti", "x", "val", "p", "i", "c", None)])
        raise ZeroDivisionError
    with database.reading() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM frame").scalar_one() == 0


def test_evidence_is_deleted_with_its_prediction(database: Database) -> None:
    frame_id = _frame(database, "unlabeled")
    with database.writing() as connection:
        store(connection, "round", [(1, 1, None, "{}", "0", 0)])
        store(connection, "prediction", [(1, frame_id, 0, "Car", 0.5, *[1.0] * 7, None)])
        store(connection, "weight", [(1, frame_id, 0, "spsl", 1.0, 1.0, 0.5)])
        bulk.delete_frames(connection, "prediction", 1, [frame_id])
        assert connection.exec_driver_sql("SELECT count(*) FROM weight").scalar_one() == 0


def test_a_damaged_file_is_reported_with_a_fix(tmp_path: Path) -> None:
    """A random file in place of a database gives a one-line error."""
    path = tmp_path / "curate.db"
    path.write_bytes(b"not a database at all" * 100)
    with pytest.raises(DatabaseError, match=r"curate.db.*not a database.*restore") as error:
        Database(f"sqlite:///{path}")
    assert "\n" not in str(error.value)


def test_a_dropped_table_is_reported(database: Database) -> None:
    """At once, not by the first command that needs it."""
    with database.writing() as connection:
        drop_views(connection)
        connection.exec_driver_sql("DROP TABLE weight")
    database.close()
    with pytest.raises(DatabaseError, match="table weight is missing; restore a backup"):
        Database(database.url)


def test_a_database_of_a_newer_curate_is_rejected(database: Database) -> None:
    """Its schema is unknown here."""
    with database.writing() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
    database.close()
    with pytest.raises(DatabaseError, match="newer curate"):
        Database(database.url)


def test_a_database_of_two_schemas_is_rejected(tmp_path: Path) -> None:
    """A second row in alembic's table, written by hand, gives a one-line error."""
    path = tmp_path / "curate.db"
    Database(f"sqlite:///{path}").close()
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("INSERT INTO alembic_version VALUES ('0001')")
        connection.commit()
    with pytest.raises(DatabaseError, match="lists several schemas; restore a backup"):
        Database(f"sqlite:///{path}")


@pytest.mark.parametrize("table", ["photos", "frame"])
def test_a_database_of_another_program_is_not_changed(tmp_path: Path, table: str) -> None:
    """The error lists its tables, and not a byte of it changes."""
    path = tmp_path / "curate.db"
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(f"CREATE TABLE {table} (id, name)")
    before = path.read_bytes()
    with pytest.raises(
        DatabaseError, match=f"has a table {table}, but table alembic_version has no schema"
    ):
        Database(f"sqlite:///{path}")
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_the_revisions_by_file_name_are_those_of_alembic() -> None:
    """From the first to the head, though a database is opened without alembic."""
    config = Config()
    config.set_main_option("script_location", str(ROOT / "db" / "migrations"))
    script = ScriptDirectory.from_config(config)
    assert [each.revision for each in script.walk_revisions()][::-1] == REVISIONS
    assert script.get_current_head() == REVISIONS[-1]
