"""The described schema matches the databases, and every column has a meaning."""

import csv
import io
import json
import re
from pathlib import Path

import pytest
from sqlalchemy import inspect
from support.pipelines_cli import Curate

from curate.errors import ConfigError
from pipelines.queries.schema import exported_schema, read_schema, working_schema
from pipelines.workspace.workspace import Workspace

ENGINES = ("sqlite", "postgresql")


def columns_of(schema) -> dict[tuple[str, str], list[str]]:
    """Return the names of columns by kind and name of their table or view."""
    return {(each.name, each.kind): [one.name for one in each.columns] for each in schema}


def test_the_schema_matches_the_database(workspace: Workspace) -> None:
    """Each table and view with its columns in their order."""
    with workspace.database.reading() as connection:
        inspector = inspect(connection)
        found = {
            (name, kind): [column["name"] for column in inspector.get_columns(name)]
            for kind, names in (
                ("table", inspector.get_table_names()),
                ("view", inspector.get_view_names()),
            )
            for name in names
            if name != "alembic_version"
        }
    described = read_schema(workspace.database.url, exported=False)
    assert {key: sorted(names) for key, names in columns_of(described).items()} == {
        key: sorted(names) for key, names in found.items()
    }
    views = {key: names for key, names in found.items() if key[1] == "view"}
    assert {key: columns_of(described)[key] for key in views} == views


def test_every_column_has_a_meaning() -> None:
    """And every table and view."""
    silent = [
        f"{each.name}.{column.name}"
        for each in working_schema()
        for column in each.columns
        if not column.meaning
    ]
    assert silent == []
    assert all(each.meaning for each in working_schema())


def test_quantities_have_a_unit() -> None:
    """Metres, radians, pixels, seconds, percent and numbers between 0 and 1."""
    units = {
        f"{each.name}.{column.name}": column.unit
        for each in working_schema()
        for column in each.columns
    }
    assert units["prediction.x"] == units["weighted_labels.length"] == "m"
    assert units["ground_truth.yaw"] == units["reprediction_view.rotation_rad"] == "rad"
    assert units["ground_truth.image_left"] == "px"
    assert units["task.seconds"] == "s"
    assert units["evaluation_ap.ap_r40"] == "%"
    assert units["weight.v"] == "1"


def test_the_schema_of_an_exported_file(curate: Curate, workspace: Workspace) -> None:
    """Its own tables, each column with a meaning."""
    assert curate("run", "-w", workspace.root)[0] == 0
    exported = workspace.root / "exports" / "labels.sqlite"
    schema = exported_schema(exported)
    names = ["weighted_labels", "meta", "frame", "ground_truth", "label"]
    assert [each.name for each in schema] == names
    assert [f"{r.name}.{c.name}" for r in schema for c in r.columns if not c.meaning] == []
    code, out, err = curate("query", "--schema", "label", "--json", "--file", exported)
    assert (code, err) == (0, "")
    rows = {row["column"]: row for row in json.loads(out)}
    assert rows["points"]["meaning"] == "m, LiDAR points in the box"
    assert rows["x"]["unit"] == "m"


def test_user_supplied_evidence_is_in_the_schema(curate: Curate, workspace: Workspace) -> None:
    """Its table, and its columns in the view, as the source declares them."""
    path = workspace.root / "curate.toml"
    priors = '["points", "support.toys:ToyPrior"]'
    path.write_text(re.sub(r"(?m)^priors = .*$", f"priors = {priors}", path.read_text()))
    code, _, err = curate("run", "-w", workspace.root)
    assert code == 0, err
    url, exported = workspace.database.url, workspace.root / "exports" / "labels.sqlite"
    with workspace.database.reading() as connection:
        [name] = connection.exec_driver_sql("SELECT name FROM evidence_source").scalars()
    for schema in (read_schema(url, exported=False), exported_schema(exported)):
        [view] = [each for each in schema if each.name == "weighted_labels"]
        further = view.columns[24:]
        assert further
        assert all(column.meaning for column in further)
    [table] = [each for each in read_schema(url, exported=False) if each.name == f"prior_{name}"]
    assert [column.name for column in table.columns[:3]] == ["round", "frame_id", "k"]
    assert {column.name for column in further} <= {column.name for column in table.columns}


def test_the_schema_is_printed_in_every_format(curate: Curate, workspace: Workspace) -> None:
    """One text table per table, one list in JSON and CSV."""
    _, out, _ = curate("query", "--schema", "-w", workspace.root)
    assert "weighted_labels (view): Every label" in out
    assert "ground_truth (table): The annotated objects of labeled and val frames" in out
    rows = json.loads(curate("query", "--schema", "--json", "-w", workspace.root)[1])
    table = list(csv.DictReader(io.StringIO(curate("query", "--schema", "--csv")[1])))
    assert [row["column"] for row in table] == [row["column"] for row in rows]
    assert {row["table"] for row in rows} >= {"weighted_labels", "prediction", "task"}


def test_one_table_is_described(curate: Curate, workspace: Workspace) -> None:
    """By its name; a misspelled name gets a suggestion."""
    _, out, _ = curate("query", "--schema", "weight", "-w", workspace.root)
    assert out.startswith("weight (table)")
    assert "weighted_labels" not in out.splitlines()[0]
    code, out, err = curate("query", "--schema", "wieght", "-w", workspace.root)
    assert (code, out) == (ConfigError.exit_code, "")
    assert "did you mean 'weight'?" in err


def test_the_schema_needs_no_workspace(
    curate: Curate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = curate("query", "--schema")
    assert (code, err) == (0, "")
    assert "weighted_labels (view)" in out
    assert curate("query", "--schema", "-w", tmp_path / "gone")[0] != 0


@pytest.mark.parametrize(
    ("sql", "meant"),
    [
        ("SELECT weigth FROM weighted_labels", "weight"),
        ("SELECT w.scroe FROM weighted_labels AS w", "score"),
        ("SELECT frame FROM weighted_label", "weighted_labels"),
        ("SELECT p.frame FROM predictions AS p", "prediction"),
    ],
)
def test_a_misspelled_name_gets_a_suggestion(
    curate: Curate, workspace: Workspace, engine: str, sql: str, meant: str
) -> None:
    """With the command that lists the known names; on a server, too."""
    code, out, err = curate("query", sql, "-w", workspace.root)
    assert (code, out) == (ConfigError.exit_code, "")
    assert f"did you mean '{meant}'? `curate query --schema`" in err
    assert err.count("\n") == 1


def test_an_unknown_name_refers_to_the_schema(curate: Curate, workspace: Workspace) -> None:
    """If no name is similar."""
    _, _, err = curate("query", "SELECT qqqqqqqq FROM frame", "-w", workspace.root)
    assert "did you mean" not in err
    assert "`curate query --schema` lists tables and columns" in err


def test_a_column_of_another_table_is_named_with_its_table(
    curate: Curate, workspace: Workspace, engine: str
) -> None:
    """A suggestion of the very same name would not help."""
    _, _, err = curate("query", "SELECT rho_diff FROM frame", "-w", workspace.root)
    assert "; it is a column of point_prior, weighted_labels" in err
    _, _, err = curate("query", "SELECT frame_id FROM weighted_labels", "-w", workspace.root)
    assert "; it is a column of " in err
    assert err.endswith(" and others\n")


def test_an_unknown_function_gets_a_suggestion(
    curate: Curate, workspace: Workspace, engine: str
) -> None:
    """On a server, with a replacement for the functions that curate adds to SQLite."""
    sql = {"sqlite": "SELECT medain(1)", "postgresql": "SELECT median(1)"}[engine]
    word = {"sqlite": "did you mean 'median'?", "postgresql": "percentile_cont(0.5) WITHIN GROUP"}
    _, _, err = curate("query", sql, "-w", workspace.root)
    assert word[engine] in err
