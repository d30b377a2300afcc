"""Queries that would write, read other files, or use up time and memory, on SQLite."""

from pathlib import Path

import pytest
from support.pipelines_cli import Curate

from curate.errors import ConfigError
from pipelines.workspace.workspace import Workspace


@pytest.mark.parametrize(
    "sql",
    [
        "ATTACH DATABASE '{outside}' AS other",
        "PRAGMA query_only = OFF",
        "PRAGMA writable_schema = ON",
        "SELECT * FROM pragma_table_info('frame')",
        "SELECT load_extension('evil')",
        "SELECT readfile('/etc/passwd')",
        "SELECT writefile('{outside}', 'x')",
        "SELECT 1; DELETE FROM frame",
        "WITH gone AS (SELECT 1) DELETE FROM frame",
        "WITH new(i) AS (SELECT 1) INSERT INTO checkpoint SELECT * FROM checkpoint",
        "INSERT INTO frame SELECT * FROM frame",
        "UPDATE weight SET v = 1",
        "DROP TABLE weight",
        "CREATE TEMP TABLE t AS SELECT 1",
        "VACUUM INTO '{outside}'",
        "BEGIN IMMEDIATE",
        "REINDEX",
        "ANALYZE",
        "SELECT fts3_tokenizer('simple')",
        "SELECT '\ud800'",
        "SELECT 1 \x00 FROM frame",
        "",
    ],
)
def test_a_query_reads_only_the_database(
    curate: Curate, workspace: Workspace, tmp_path: Path, sql: str
) -> None:
    """No other file is read or written, and no row is changed."""
    outside = tmp_path / "outside.db"
    before = (workspace.root / "curate.db").read_bytes()
    code, out, err = curate("query", sql.format(outside=outside), "-w", workspace.root)
    assert (code, out) == (ConfigError.exit_code, "")
    assert err.count("\n") == 1
    assert not outside.exists()
    assert (workspace.root / "curate.db").read_bytes() == before


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "


@pytest.mark.parametrize(
    ("sql", "word"),
    [
        (ENDLESS + "SELECT count(*) FROM n", "stopped after 0.5 seconds"),
        (ENDLESS + "SELECT i FROM n WHERE i < 0", "stopped after 0.5 seconds"),
        ("SELECT length(randomblob(1000000000))", "too big"),
        ("SELECT length(zeroblob(900000000))", "too big"),
        ("SELECT hex(zeroblob(4000000))", "too big"),
        (ENDLESS + "SELECT length(group_concat('xxxxxxxxxxxxxxxxxxxxxxxxxxxxxx' || i)) FROM n", ""),
        ("SELECT replace(hex(zeroblob(1000000)), '0', 'xxxxxxxxxxxxxxxxxxxxxxx')", "too big"),
        ("SELECT " + ", ".join(["1"] * 600), "too many columns"),
    ],
)
def test_a_query_is_stopped_at_its_limits(
    curate: Curate, workspace: Workspace, sql: str, word: str
) -> None:
    """Of time and memory, with a one-line error."""
    code, out, err = curate("query", sql, "--seconds", "0.5", "-w", workspace.root)
    assert (code, out) == (ConfigError.exit_code, "")
    assert word in err
    assert err.count("\n") == 1


def test_an_endless_result_is_stopped_while_it_is_printed(
    curate: Curate, workspace: Workspace
) -> None:
    """Rows are printed as they are found, and not kept."""
    for form in ("csv", "json"):
        sql = ENDLESS + "SELECT i FROM n"
        code, out, err = curate(
            "query", sql, "--seconds", "0.2", "--format", form, "-w", workspace.root
        )
        assert code == ConfigError.exit_code
        assert "stopped" in err
        assert len(out.splitlines()) > 100
