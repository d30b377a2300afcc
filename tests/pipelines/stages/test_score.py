"""Evidence sources as stages: the built-in ones, and external ones."""

import csv
import json
import re
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import text
from support.pipelines_cli import Curate
from support.rounds import run, run_stage
from support.toys import ToyPrior, ToySequences

from curate.errors import ConfigError
from db.evidence import read_declarations
from pipelines.labels.sources import source_of
from pipelines.registry import PRIORS
from pipelines.round import round_graph
from pipelines.workspace.config_file import write_config
from pipelines.workspace.workspace import Workspace

OWN, TRACKS = "support.toys:ToyPrior", "support.toys:ToyTracks"
ENGINES = ("sqlite", "postgresql")


def rows(workspace: Workspace, columns: str = "*") -> list[dict[str, Any]]:
    """Return the rows of the view, by column name."""
    with workspace.database.reading() as connection:
        query = text(f"SELECT {columns} FROM weighted_labels ORDER BY frame, k")
        return [dict(row) for row in connection.execute(query).mappings()]


def test_an_external_prior_has_its_columns_everywhere(
    curate: Curate, workspace: Workspace, tmp_path: Path
) -> None:
    """In the view, the weights, the exports, the explanation, the report and queries."""
    own = workspace.with_settings(
        "run", priors=("points", OWN), prior_options={OWN: {"plenty": 30.0}}
    )
    write_config(workspace.root / "curate.toml", own.config)
    assert run(own)[OWN] == 6
    found = rows(own)
    assert len(found) == 18
    assert list(found[0])[-4:] == ["weight", "near_points", "nearest", "rho_toy"]
    for row in found:
        assert row["rho_toy"] == pytest.approx(min(row["near_points"] / 30, 1))
        assert row["rho_det"] == pytest.approx(row["rho_diff"] * row["rho_toy"])
    assert {type(row["near_points"]) for row in found} == {int}
    with closing(sqlite3.connect(own.root / "exports" / "labels.sqlite")) as exported:
        exported.row_factory = sqlite3.Row
        query = "SELECT * FROM weighted_labels ORDER BY frame, k"
        assert [dict(row) for row in exported.execute(query)] == found
    for name in ("csv", "parquet"):
        path = tmp_path / f"labels.{name}"
        assert curate("export", "--format", name, "--output", path, "-w", own.root)[0] == 0
    with (tmp_path / "labels.csv").open(newline="") as file:
        written = list(csv.DictReader(file))
    assert [float(row["nearest"]) for row in written] == [row["nearest"] for row in found]
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is an extra")
    table = parquet.read_table(tmp_path / "labels.parquet")
    assert table.column("near_points").to_pylist() == [row["near_points"] for row in found]
    assert str(table.schema.field("near_points").type) == "int32"
    frame = found[0]["frame"]
    code, out, err = curate("explain", frame, "0", "-w", own.root)
    assert code == 0, err
    assert f"near_points = {found[0]['near_points']}" in out
    assert f"rho_toy {found[0]['rho_toy']:.4f}" in out
    assert "recomputed" in out
    assert "they differ" not in out
    assert curate("report", "-w", own.root)[0] == 0
    page = (own.root / "reports" / "round-01-pspsl.html").read_text()
    assert "toy prior: near_points / plenty, at most 1" in page
    sql = "SELECT rho_toy FROM weighted_labels ORDER BY frame, k"
    out = curate("query", sql, "--json", "-w", own.root)[1]
    assert [row["rho_toy"] for row in json.loads(out)] == [row["rho_toy"] for row in found]


def test_a_sequence_source_sees_whole_sequences(workspace: Workspace) -> None:
    """Its columns are in the view; it is not a prior, so the weights do not change."""
    sequenced = workspace.with_settings(
        "dataset", kind="support.toys:ToySequences", split_by="frame"
    )
    run(sequenced)
    before = [row["weight"] for row in rows(sequenced)]
    own = sequenced.with_settings("run", priors=("points", "semantic", TRACKS))
    assert run(own)[TRACKS] == 6
    found = rows(own)
    assert [row["weight"] for row in found] == before
    frames = list(own.frames("unlabeled"))
    for row in found:
        sequence = ToySequences.sequence_name(row["frame"])
        members = [name for name in frames if ToySequences.sequence_name(name) == sequence]
        assert row["occurrences"] == len(members)
        assert row["first_frame"] == members[0]
    assert run(own)[TRACKS] == 0


def test_a_replaced_prior_gets_new_evidence(workspace: Workspace) -> None:
    """Each source has its own table; after switching back, nothing is computed again."""
    run(workspace)
    before = rows(workspace)
    own = workspace.with_settings("run", priors=(OWN, "semantic"))
    done = run(own)
    assert (done[OWN], done["semantic"]) == (6, 0)
    assert [row["weight"] for row in rows(own)] != [row["weight"] for row in before]
    assert run(workspace)["points"] == 0
    core = [{name: row[name] for name in before[0]} for row in rows(workspace)]
    assert core == before
    assert run(own)[OWN] == 0


def test_a_changed_declaration_recreates_its_table(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The values are computed again; one line reports it."""
    own = workspace.with_settings("run", priors=("points", OWN))
    run(own)
    changed = tuple(replace(column, unit="m") for column in ToyPrior.columns)
    monkeypatch.setattr(ToyPrior, "columns", changed)
    source_of.cache_clear()
    assert run(own)[OWN] == 6
    [line] = [each for each in caplog.messages if "is replaced" in each]
    assert "evidence source 'toy'" in line
    assert "prior_toy" in line
    source_of.cache_clear()


def test_a_reworded_meaning_keeps_the_evidence(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Nothing is computed, exported or trained again; the new words are shown."""
    own = workspace.with_settings("run", priors=("points", OWN))
    run(own)
    before = rows(own)
    reworded = tuple(replace(column, meaning="other words") for column in ToyPrior.columns)
    monkeypatch.setattr(ToyPrior, "columns", reworded)
    source_of.cache_clear()
    assert set(run(own).values()) == {0}
    assert not [each for each in caplog.messages if "is replaced" in each]
    assert rows(own) == before
    with own.database.reading() as connection:
        [stored] = [each for each in read_declarations(connection) if each.name == "toy"]
    assert {column.meaning for column in stored.columns} == {"other words"}
    source_of.cache_clear()


def test_a_source_removed_from_the_configuration_is_reported(
    workspace: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    """Its table stays, its columns are shown, and no weight uses it."""
    run(workspace.with_settings("run", priors=("points", OWN)))
    caplog.clear()
    # Without the source, no car has a weight above 0.
    run(replace(workspace, allow_empty=True))
    lines = [each for each in caplog.messages if "no longer in run.priors" in each]
    assert len(set(lines)) == 1
    assert "'toy'" in lines[0]
    assert "prior_toy" in lines[0]
    for row in rows(workspace):
        assert row["rho_toy"] is not None
        assert row["rho_det"] == pytest.approx(row["rho_diff"] * row["rho_anno"])


COLUMN = ToyPrior.columns[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"columns": (COLUMN, COLUMN)}, "'toy'.*'near_points': declared twice"),
        ({"columns": (replace(COLUMN, name="score"),)}, "'score': the name is reserved"),
        ({"columns": (replace(COLUMN, name="rho_diff"),)}, "'rho_diff': the name is reserved"),
        ({"columns": (replace(COLUMN, name="probability"),)}, "'probability': .* reserved"),
        ({"columns": (replace(COLUMN, name="No good"),)}, "'No good': the name must be of"),
        ({"columns": (replace(COLUMN, kind="int128"),)}, "unknown type 'int128', use one of int32"),
        ({"columns": ()}, "'toy': declares no columns"),
        ({"name": "Toy prior"}, "'Toy prior': the name must be of"),
        ({"rho_column": "trust"}, "rho_column 'trust' is not a declared column"),
        ({"name": "points"}, "the name 'points' is taken"),
    ],
)
def test_a_wrong_declaration_is_rejected_before_any_work(
    monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], message: str
) -> None:
    """The one-line error contains the source and the column."""
    for name, value in changes.items():
        monkeypatch.setattr(ToyPrior, name, value)
    source_of.cache_clear()
    with pytest.raises(ConfigError, match=message) as caught:
        round_graph(("points", OWN))
    assert "\n" not in str(caught.value)
    source_of.cache_clear()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"rho_toy": [0.5]}, "column rho_toy has 1 rows, not 3"),
        ({"rho_toy": [0.5, np.nan, 0.5]}, "rho_toy of label 1 is None, but the column is not"),
        ({"rho_toy": [0.5, 1.5, 0.5]}, r"rho_toy of label 1 is 1.5, not in \[0, 1\]"),
        ({"near_points": [1, 2.5, 3]}, "near_points of label 1 is 2.5, not a number of int32"),
        ({"near_points": [1, 2**40, 3]}, "near_points of label 1 is 1099511627776, not a number"),
        ({"nearest": ["a", "b", "c"]}, "nearest of label 0 is 'a', not a finite number"),
        ({"more": [1, 2, 3]}, "column more is not declared"),
    ],
)
def test_wrong_evidence_fails_its_frame_in_one_line(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch, wrong: dict[str, list], message: str
) -> None:
    """The line contains the source and the column."""
    right = ToyPrior.rate
    monkeypatch.setattr(
        ToyPrior,
        "rate",
        lambda self, *arguments: {
            **right(self, *arguments),
            **{name: np.array(values) for name, values in wrong.items()},
        },
    )
    own = workspace.with_settings("run", priors=("points", OWN))
    run_stage(own, "predict")
    report = run_stage(own, OWN)
    assert report.failed == 6
    for _, error in report.errors:
        assert re.search(f"evidence source 'toy': .*{message}", error), error
        assert "\n" not in error


def test_changed_maps_in_the_same_folder_make_the_evidence_stale(
    workspace: Workspace, tmp_path: Path
) -> None:
    """If the segmenter is a folder, replaced or renamed files count; reading them does not."""
    maps = tmp_path / "maps"
    maps.mkdir()
    (maps / "a.png").write_bytes(b"one map")
    own = workspace.with_settings("segmenter", path=maps)
    assert run(own)["semantic"] == 6
    assert run(own)["semantic"] == 0
    (maps / "a.png").write_bytes(b"another one")
    assert run(own)["semantic"] == 6
    (maps / "a.png").rename(maps / "b.png")
    assert run(own)["semantic"] == 6
    assert run(own)["semantic"] == 0


def test_two_sources_of_one_name_are_rejected() -> None:
    """The error contains both."""
    with pytest.raises(ConfigError, match=r"ToyPrior and .*ToyPriorAgain have the same name 'toy'"):
        round_graph((OWN, "support.toys:ToyPriorAgain"))


def test_an_unknown_prior_is_rejected() -> None:
    """A misspelt name is not ignored."""
    known = ", ".join(sorted(PRIORS.classes))
    with pytest.raises(ConfigError, match=f"unknown prior 'pionts': use one of {known}"):
        round_graph(("pionts",))


def test_the_default_round_has_a_stage_per_registered_prior() -> None:
    """In the order of the registry, between repredict and calibrate."""
    graph = round_graph(tuple(PRIORS.classes))
    names = [each.name for each in graph.stages]
    assert names[names.index("repredict") + 1 : names.index("calibrate")] == list(PRIORS.classes)
    alone = [each.name for each in round_graph(("semantic",)).stages]
    assert alone == [name for name in names if name not in PRIORS.classes or name == "semantic"]
    assert graph.stage("points").reads == ("frame", "ground_truth", "prediction")
    assert graph.stage("semantic").reads == ("frame", "maps", "prediction")
