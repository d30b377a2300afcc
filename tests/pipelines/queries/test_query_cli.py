"""`curate query`: the queries that ship with curate, output formats, other files."""

import csv
import io
import json
import sqlite3
from pathlib import Path

import pytest
from support.pipelines_cli import Curate

from curate.errors import ConfigError
from pipelines.assessment.audit import EVIDENCE
from pipelines.commands.query import AUDITED
from pipelines.queries.named_queries import named_queries
from pipelines.workspace.workspace import Workspace

ENGINES = ("sqlite", "postgresql")
QUERIES = named_queries()


@pytest.fixture
def weighted(curate: Curate, workspace: Workspace) -> Path:
    """Return a toy workspace with weights and an exported file."""
    code, _, err = curate("run", "-w", workspace.root)
    assert code == 0, err
    return workspace.root


def test_every_named_query_is_described_and_runs(curate: Curate, weighted: Path) -> None:
    """On the working database.

    Also on the exported file if the query supports it, with the same rows.
    """
    exported = weighted / "exports" / "labels.sqlite"
    for name, query in QUERIES.items():
        assert query.description, name
        assert not query.sql.startswith("--"), name
        code, out, err = curate("query", "--named", name, "--json", "-w", weighted)
        assert (code, err) == (0, ""), name
        result = json.loads(out)
        code, out, err = curate("query", "--named", name, "--json", "--file", exported)
        if query.exported:
            assert (code, err) == (0, ""), name
            if name != "splits":  # an exported file has no val frames
                assert _rounded(json.loads(out)) == _rounded(result), name
        else:
            assert code == ConfigError.exit_code, f"{name} works on the exported file: say so"


def _rounded(rows: list[dict]) -> list[dict]:
    """Round values: sums in another order differ in their last digits."""
    return [
        {key: round(value, 9) if isinstance(value, float) else value for key, value in row.items()}
        for row in rows
    ]


def test_the_results_agree_with_the_labels(curate: Curate, weighted: Path) -> None:
    """Kept labels add up to those of the view; frames belong to their splits."""
    kept = "sum(CASE WHEN weight > 0 THEN 1 ELSE 0 END) AS kept"
    sql = f"SELECT count(*) AS n, {kept}, max(lambda_u) AS age FROM weighted_labels"
    [whole] = json.loads(curate("query", sql, "--json", "-w", weighted)[1])

    def query_rows(name: str) -> list[dict]:
        return json.loads(curate("query", "--named", name, "--format", "json", "-w", weighted)[1])

    assert whole["n"] == 18
    assert sum(row["labels"] for row in query_rows("kept")) == whole["n"]
    assert sum(row["kept"] for row in query_rows("kept")) == whole["kept"] > 0
    assert {row["distance"] for row in query_rows("kept")} <= {"00-20 m", "20-40 m"}
    assert [row["greatest_lambda"] for row in query_rows("age")] == [whole["age"]]
    assert {row["split"]: row["frames"] for row in query_rows("splits")} == {
        "labeled": 2, "unlabeled": 6, "val": 4,
    }  # fmt: skip
    assert all(row["score"] >= 0.5 and row["weight"] < 0.2 for row in query_rows("doubted"))


def test_missed_objects_are_listed_after_an_evaluation(curate: Curate, weighted: Path) -> None:
    """Each missed object of `evaluate --store`, once."""
    code, _, err = curate("evaluate", "--store", "-w", weighted)
    assert code == 0, err
    sql = "SELECT count(*) AS n FROM evaluation_object WHERE side = 'object' AND outcome = 'fn'"
    [missed] = json.loads(curate("query", sql, "--json", "-w", weighted)[1])
    rows = json.loads(curate("query", "--named", "missed", "--json", "-w", weighted)[1])
    assert len(rows) == missed["n"]
    assert json.loads(curate("query", "--named", "precision", "--json", "-w", weighted)[1])


def test_named_queries_accept_a_policy_and_a_round(
    curate: Curate, weighted: Path, engine: str
) -> None:
    """The rows are a part of the whole result; each query lists its options."""
    assert curate("solve", "--policy", "spsl", "--round", "1", "-w", weighted)[0] == 0
    assert curate("audit", "--replicates", "10", "-w", weighted)[0] == 0

    def rows(name: str, *options: str) -> list[dict]:
        code, out, err = curate("query", "--named", name, "--json", *options, "-w", weighted)
        assert (code, err) == (0, ""), name
        return json.loads(out)

    selected = set()
    for name, query in QUERIES.items():
        whole = rows(name)
        for column, value in (("policy", "spsl"), ("round", 1)):
            if column not in query.filters:
                continue
            found = rows(name, f"--{column}", str(value))
            if whole and column in whole[0]:
                expected = [row for row in whole if row[column] == value]
                assert _rounded(found) == _rounded(expected), name
                selected |= {(name, column)} if len(expected) < len(whole) else set()
        if "round" in query.filters:
            assert rows(name, "--round", "999") == []
    assert {("kept", "policy"), ("counts", "policy"), ("reliability", "policy")} <= selected
    both = rows("kept", "--policy", "spsl", "--round", "1")
    assert {(row["policy"], row["round"]) for row in both} == {("spsl", 1)}


def test_stored_audits_can_be_queried() -> None:
    """Evidence is listed beside the policies."""
    assert tuple(EVIDENCE) == AUDITED
    sql = QUERIES["kept"].filtered("it's", None)
    assert "policy = 'it''s'" in sql


def test_the_list_contains_every_query(curate: Curate) -> None:
    """Without a workspace, in every format."""
    code, out, _ = curate("query", "--list")
    assert code == 0
    assert all(name in out for name in QUERIES)
    rows = list(csv.DictReader(io.StringIO(curate("query", "--list", "--format", "csv")[1])))
    assert [row["name"] for row in rows] == list(QUERIES)
    assert json.loads(curate("query", "--list", "--json")[1])[0]["name"] == rows[0]["name"]


def test_a_folder_that_cannot_be_written_names_the_remedy(curate: Curate, tmp_path: Path) -> None:
    """SQLite needs a file beside the database, which a folder in its place prevents."""
    path = tmp_path / "copy.db"
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("CREATE TABLE frame (frame TEXT)")
    connection.close()
    (tmp_path / "copy.db-wal").mkdir()
    code, out, err = curate("query", "SELECT frame FROM frame", "--file", path)
    assert (code, out) == (ConfigError.exit_code, "")
    assert "must be able to write in its folder" in err


@pytest.mark.parametrize(("limit", "words"), [(0, "no rows\n"), (1, "")])
def test_an_empty_table_says_that_it_is_empty(
    curate: Curate, workspace: Workspace, limit: int, words: str
) -> None:
    """On standard error, so that a pipe gets the table alone."""
    code, out, err = curate("query", f"SELECT frame FROM frame LIMIT {limit}", "-w", workspace.root)
    assert (code, err) == (0, words)
    assert out.startswith("frame")


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--named", "nothing"], "use one of age,"),
        (["--format", "xml", "SELECT 1"], "table, csv, json"),
        ([], "give one of"),
        (["--named", "kepd"], "did you mean 'kept'?"),
        (["--named", "kept", "--policy", "pspls"], "did you mean 'pspsl'?"),
        (["--named", "splits", "--policy", "pspsl"], "the query 'splits' has no column policy"),
        (["--named", "false", "--round", "1"], "the query 'false' has no column round"),
        (["SELECT 1", "--policy", "pspsl"], "go with --named"),
        (["--schema", "--named", "kept"], "give one of"),
        (["SELECT 1", "--named", "age"], "give one of"),
        (["SELECT 1", "--file", "gone.sqlite"], "curate export"),
    ],
)
def test_a_wrong_call_says_what_to_do(
    curate: Curate, workspace: Workspace, arguments: list[str], word: str
) -> None:
    """One line, and the exit code of a wrong argument."""
    code, out, err = curate("query", *arguments, "-w", workspace.root)
    assert (code, out) == (ConfigError.exit_code, "")
    assert word in err
    assert err.count("\n") == 1


def test_the_exported_file_is_read_only(curate: Curate, weighted: Path) -> None:
    """Like the working database."""
    exported = weighted / "exports" / "labels.sqlite"
    code, _, err = curate("query", "DELETE FROM label", "--file", exported)
    assert code == ConfigError.exit_code
    assert "read-only" in err


def test_a_huge_value_is_rejected(curate: Curate, workspace: Workspace, engine: str) -> None:
    """A server, too, would otherwise create a gigabyte."""
    huge = {
        "sqlite": "replace(hex(zeroblob(999999)), '0', 'long')",
        "postgresql": "repeat('x', 5000000)",
    }
    sql = f"SELECT {huge[engine]} AS value"
    code, _, err = curate("query", sql, "-w", workspace.root)
    assert code == ConfigError.exit_code
    assert err == "error: query: string or blob too big\n"
