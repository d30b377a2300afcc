"""Track evidence as a stage: its columns everywhere, and data sets that cannot have it."""

from pathlib import Path
from typing import Any

from sqlalchemy import text
from support.dataset_layouts import write_toy_folder
from support.pipelines_cli import Curate
from support.rounds import run
from support.toys import ToySequences, write_toy_kitti

from pipelines.workspace.config_file import write_config
from pipelines.workspace.workspace import Workspace

PRIORS = ("points", "semantic", "tracks")


def rows(workspace: Workspace, columns: str = "*") -> list[dict[str, Any]]:
    """Return the rows of the view, by column name."""
    with workspace.database.reading() as connection:
        query = text(f"SELECT {columns} FROM weighted_labels ORDER BY frame, k")
        return [dict(row) for row in connection.execute(query).mappings()]


def test_tracks_are_evidence_and_no_prior(curate: Curate, workspace: Workspace) -> None:
    """The columns are in the view and the explanation; the weights do not change."""
    sequenced = workspace.with_settings(
        "dataset", kind="support.toys:ToySequences", split_by="frame"
    )
    run(sequenced)
    before = [row["weight"] for row in rows(sequenced)]
    own = sequenced.with_settings("run", priors=PRIORS)
    write_config(own.root / "curate.toml", own.config)
    assert run(own)["tracks"] == 6
    found = rows(own)
    assert [row["weight"] for row in found] == before
    for row in found:
        sequence = ToySequences.sequence_name(row["frame"])
        members = {
            each["frame"] for each in found if ToySequences.sequence_name(each["frame"]) == sequence
        }
        assert row["track_hits"] + row["track_misses"] == len(members) - 1
        assert 1 <= row["track_length"] <= len(members)
        assert row["track_score"] <= row["track_max_score"]
    assert run(own)["tracks"] == 0
    code, out, err = curate("explain", found[0]["frame"], "0", "-w", own.root)
    assert code == 0, err
    assert "track of" in out
    # Another rate is another evidence: it is computed again.
    slow = own.with_settings("run", prior_options={"tracks": {"rate_hz": 0.5}})
    assert run(slow)["tracks"] == 6
    assert {row["track_length"] for row in rows(slow)} == {1}


def test_a_failed_frame_is_a_gap(workspace: Workspace) -> None:
    """The other frames of its sequence have their evidence."""
    sequenced = workspace.with_settings(
        "dataset", kind="support.toys:ToySequences", split_by="frame"
    )
    own = sequenced.with_settings("run", priors=("points", "tracks"))
    broken = sorted(own.frames("unlabeled"))[1]
    own.dataset.files(broken).points.write_bytes(b"123")
    run(own)
    with own.database.reading() as connection:
        query = (
            "SELECT DISTINCT f.frame FROM prior_tracks AS t JOIN frame AS f ON f.id = t.frame_id"
        )
        scored = {row[0] for row in connection.execute(text(query))}
    assert scored == set(own.frames("unlabeled")) - {broken}


def init(curate: Curate, root: Path, work: Path, kind: str) -> tuple[int, str, str]:
    """Run `curate init` with tracks."""
    setting = 'run.priors=["points", "tracks"]'
    options = ("--segmenter", "none", "--labeled", "1", "--set", setting)
    return curate("init", work, "--dataset", kind, "--root", root, *options)


def test_a_data_set_without_sequences_is_reported_at_init(curate: Curate, tmp_path: Path) -> None:
    write_toy_kitti(tmp_path / "data", 3)
    code, _, err = init(curate, tmp_path / "data", tmp_path / "work", "kitti")
    assert code == 2
    assert "run.priors: 'tracks' needs sequences, but the data set" in err
    assert "leave 'tracks' out of run.priors" in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "work").exists()


def test_an_unknown_time_is_reported_at_init(curate: Curate, tmp_path: Path) -> None:
    root = tmp_path / "data"
    write_toy_folder(root, 2)
    description = root / "dataset.toml"
    description.write_text('sequence_separator = "_"\n' + description.read_text())
    for i, name in enumerate(("clip_dawn", "clip_noon")):
        for path in root.glob(f"*/{i:06d}.*"):
            path.rename(path.with_name(f"{name}{path.suffix}"))
    code, _, err = init(curate, root, tmp_path / "work", "folder")
    assert code != 0
    assert "run.priors: frame clip_dawn: evidence source tracks needs the time" in err
    assert not (tmp_path / "work").exists()


def test_score_reports_a_data_set_without_sequences(curate: Curate, workspace: Workspace) -> None:
    own = workspace.with_settings("run", priors=("points", "tracks"))
    write_config(own.root / "curate.toml", own.config)
    code, _, err = curate("score", "--prior", "tracks", "-w", own.root)
    assert code == 2
    assert "needs sequences" in err
