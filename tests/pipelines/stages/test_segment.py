"""segment: maps are made once, and no result depends on whether they are there."""

import json
import shlex
import shutil
import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import text
from support.pipelines_cli import Curate
from support.rounds import run, run_workspace
from support.stored_rows import dump
from support.toys import toy_document

from curate.warnings_once import warn_once
from pipelines.round import graph_of
from pipelines.workspace.config import make_config
from pipelines.workspace.config_file import write_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

SEGMENTER = "support.toys:ToyImageSegmenter"


@pytest.fixture
def segmented(workspace: Workspace) -> Workspace:
    """Return the toy workspace with a segmenter whose maps are stored."""
    changed = workspace.with_settings("segmenter", name=SEGMENTER)
    store(changed)
    warn_once.cache_clear()
    return changed


def store(workspace: Workspace) -> None:
    """Write the settings of a workspace, as a user would, into its file."""
    config = workspace.with_settings("segmenter", cache=None).config
    write_config(workspace.root / "curate.toml", config)


def trained(workspace: Workspace) -> Workspace:
    """Return the workspace with a trainer, so that it has several rounds."""
    trainer = workspace.root / "trainer.py"
    trainer.write_text("import sys; open(sys.argv[1], 'w').write('student')")
    command = f"{shlex.join([sys.executable, str(trainer)])} {{output}}"
    return workspace.with_settings("train", command=command)


def calls(workspace: Workspace, name: str = "segmented.txt") -> list[str]:
    """Return the frames that the segmenter has seen, in order; then forget them."""
    path = workspace.config.segmenter.path.with_name(name)
    seen = path.read_text().split() if path.exists() else []
    path.unlink(missing_ok=True)
    return seen


def maps(workspace: Workspace) -> list[Path]:
    """Return the files of the stored maps."""
    return sorted(workspace.config.segmenter.cache.glob("*/*/*.gz"))


def evidence(workspace: Workspace) -> list[tuple]:
    """Return the semantic evidence of all labels."""
    with workspace.database.reading() as connection:
        query = "SELECT frame, k, mask_pixels, box_pixels, rho_anno FROM weighted_labels"
        return sorted(tuple(row) for row in connection.execute(text(query)))


def test_each_image_is_segmented_once(segmented: Workspace, curate: Curate) -> None:
    """Before predict; the semantic prior, a second round and another run read the maps."""
    done = run(segmented)
    assert list(done)[:2] == ["segment", "predict"]
    assert (done["segment"], done["semantic"]) == (6, 6)
    assert sorted(calls(segmented)) == sorted(segmented.frames("unlabeled"))
    assert len(maps(segmented)) == 6
    assert run(segmented)["segment"] == 0
    reports = run_workspace(trained(segmented), rounds=2)
    assert [(each.done, each.kept) for each in reports if each.stage == "segment"] == [(0, 6)] * 2
    assert calls(segmented) == []
    out = curate("status", "-w", segmented.root)[1]
    assert [line.split() for line in out.splitlines() if "  segment" in line] == [
        ["0", "segment", "unlabeled", "done", "6", "0", "0", "0"]
    ]


@pytest.mark.parametrize("state", ["no store", "empty", "half", "damaged", "another size"])
def test_no_result_depends_on_the_stored_maps(
    segmented: Workspace, another: Callable[[Path], Workspace], tmp_path: Path, state: str
) -> None:
    """The rows are those of a run that segments in the semantic prior, as before."""
    plain = another(tmp_path / "plain").with_settings("segmenter", name=SEGMENTER, cache_limit=0.0)
    assert "segment" not in run(plain)
    expected = evidence(plain)
    assert maps(plain) == []
    if state == "no store":
        assert sorted(calls(plain)) == sorted(plain.frames("unlabeled"))
        return
    run(segmented)
    calls(segmented)
    for path in maps(segmented)[:3] if state == "half" else maps(segmented):
        if state == "damaged":
            path.write_bytes(path.read_bytes()[:-9])
        elif state == "another size":
            path.write_bytes(maps(segmented)[0].read_bytes())
        else:
            path.unlink()
    with segmented.database.writing() as connection:
        connection.execute(text("DELETE FROM task WHERE stage = 'semantic'"))
    run(segmented)
    assert evidence(segmented) == expected
    made = {"empty": 6, "half": 3, "damaged": 6, "another size": 5}
    assert len(calls(segmented)) == made[state]
    assert len(maps(segmented)) == 6


def test_a_second_workspace_shares_the_maps(
    segmented: Workspace, another: Callable[[Path], Workspace], tmp_path: Path
) -> None:
    """With segmenter.cache; a category's other name changes no map, a segmenter's option does."""
    run(segmented)
    calls(segmented)
    cache = segmented.config.segmenter.cache
    other = another(tmp_path / "other").with_settings("segmenter", name=SEGMENTER, cache=cache)
    run(other)
    assert evidence(other) == evidence(segmented)
    assert calls(other) == []
    assert maps(other) == maps(segmented)
    changed = other.with_settings("segmenter", options={"bright": 200})
    run(changed)
    assert len(calls(changed)) == 6
    assert evidence(changed) != evidence(segmented)
    assert len(maps(segmented)) == 12


def test_folds_of_an_audit_share_the_maps(segmented: Workspace, curate: Curate) -> None:
    """Each labeled frame is segmented once, whatever the number of folds."""
    for folds in (2, 2):
        code, _, err = curate("audit", "--folds", folds, "-w", segmented.root)
        assert code == 0, err
    assert sorted(calls(segmented)) == sorted(segmented.frames("labeled"))
    assert not list((segmented.root / "reports").rglob("*.gz"))


def test_evidence_of_the_former_version_stays_valid(segmented: Workspace, curate: Curate) -> None:
    """A finished workspace without maps: nothing runs; the next round makes the maps."""
    former = segmented.with_settings("segmenter", cache_limit=0.0)
    run(former)
    before = dump(former)
    calls(segmented)
    out = curate("run", "--dry-run", "-w", segmented.root)[1]
    assert "Everything is up to date" in out
    assert curate("run", "-w", segmented.root)[0] == 0
    assert dump(segmented) == before
    done = run(segmented.with_settings("semantic", mean="product"))
    assert (done["segment"], done["semantic"]) == (0, 6)
    assert calls(segmented) == []
    assert maps(segmented) == []
    reports = run_workspace(trained(segmented), rounds=2)
    assert [each.done for each in reports if each.stage == "segment"] == [0, 6]
    assert len(calls(segmented)) == 6


def test_the_preview_counts_each_frame_once(segmented: Workspace, curate: Curate) -> None:
    """Not again in the second round."""
    store(trained(segmented).with_settings("run", rounds=3))
    stages = json.loads(curate("run", "--dry-run", "--json", "-w", segmented.root)[1])["stages"]
    found = [(each["round"], each["frames"]) for each in stages if each["stage"] == "segment"]
    assert found == [(0, 6), (0, 0), (0, 0)]
    assert calls(segmented) == []
    stages = json.loads(curate("segment", "--dry-run", "--json", "-w", segmented.root)[1])["stages"]
    assert [(each["stage"], each["frames"]) for each in stages] == [("segment", 6)]


def test_the_command_needs_no_detector(segmented: Workspace, curate: Curate) -> None:
    """It makes the maps of any split, and counts its frames."""
    segmented.config.detector.path.unlink()
    code, out, err = curate("segment", "-w", segmented.root, "--split", "val")
    assert code == 0, err
    assert "4 frames done" in out
    assert sorted(calls(segmented)) == sorted(segmented.frames("val"))
    assert "4 already done" in curate("segment", "-w", segmented.root, "--split", "val")[1]


@pytest.mark.parametrize(
    ("section", "settings", "reason"),
    [
        ("segmenter", {"name": "support.toys:ToySegmenter"}, "declares no map_version"),
        ("segmenter", {"cache_limit": 0.0}, "segmenter.cache_limit is 0"),
        ("run", {"priors": ("points",)}, "no source in run.priors reads semantic maps"),
    ],
)
def test_the_stage_is_left_out_where_no_map_is_stored(
    segmented: Workspace, curate: Curate, section: str, settings: dict, reason: str
) -> None:
    """The command says why, and is no error."""
    changed = segmented.with_settings(section, **settings)
    store(changed)
    graph = graph_of(changed)
    assert "segment" not in [stage.name for stage in graph.stages]
    assert all("maps" not in stage.reads for stage in graph.stages)
    code, out, err = curate("segment", "-w", segmented.root)
    assert (code, err) == (0, "")
    assert reason in out


def test_a_full_folder_ends_the_stage_early_and_loses_nothing(
    segmented: Workspace, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run goes on without further maps; with a higher limit the stage continues."""
    monkeypatch.setattr("curate.segmenters.map_store._PAUSE", 0)
    full = segmented.with_settings("segmenter", cache_limit=1e-7)
    done = run(full)
    assert done["segment"] < 6
    assert done["semantic"] == 6
    assert "segment ends early" in caplog.text
    assert "raise it in curate.toml" in caplog.text
    assert "nothing is lost" in caplog.text
    stored = len(maps(segmented))
    assert 0 < stored < 6
    assert done["segment"] == stored
    assert run_workspace(full)[0].done == 0
    # A map that did not fit while its frame was in work is made by the next stage that reads it.
    assert [each.done for each in run_workspace(trained(segmented), 2) if each.stage == "segment"]
    assert len(maps(segmented)) == 6


def test_frames_that_were_in_work_when_the_folder_was_full_are_not_done(
    segmented: Workspace, curate: Curate, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Several workers have jobs while the limit is reached: their maps are made, but not stored."""
    monkeypatch.setattr("curate.segmenters.map_store._PAUSE", 0)
    monkeypatch.setattr("pipelines.engine.runner._until_refused", lambda jobs, *_: jobs)
    full = segmented.with_settings("segmenter", cache_limit=1e-7)
    assert (run(full)["segment"], len(maps(segmented))) == (1, 1)
    assert len(set(calls(segmented))) == 6
    out = curate("segment", "-w", segmented.root)[1]  # with the limit of curate.toml
    assert "5 frames done" in out
    assert len(maps(segmented)) == 6


def test_maps_of_a_deleted_folder_are_made_again(segmented: Workspace, curate: Curate) -> None:
    """The stage looks at its folder, so that it does not count maps as done that are gone."""
    assert run(segmented)["segment"] == 6
    assert run_workspace(segmented)[0].done == 0
    shutil.rmtree(segmented.root / "maps")
    assert "would work on 6 frames" in curate("segment", "-w", segmented.root, "--dry-run")[1]
    assert not (segmented.root / "maps").exists()
    code, out, _ = curate("segment", "-w", segmented.root)
    assert (code, len(maps(segmented))) == (0, 6), out
    assert "0 frames done" in curate("segment", "-w", segmented.root)[1]


def test_a_full_disk_ends_the_stage_early(
    segmented: Workspace, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No frame counts as done, and the rows of the run are complete."""
    free = shutil.disk_usage(segmented.root)._replace(free=1000)
    monkeypatch.setattr("curate.segmenters.map_store.shutil.disk_usage", lambda _: free)
    done = run(segmented)
    assert (done["segment"], done["semantic"], len(maps(segmented))) == (0, 6, 0)
    assert "segment ends early" in caplog.text
    assert "no space left for semantic maps" in caplog.text


def test_a_damaged_image_fails_its_frame_alone(segmented: Workspace, curate: Curate) -> None:
    """It is recorded, and tried again when the image is whole."""
    name = next(iter(segmented.frames("unlabeled")))
    path = segmented.dataset.files(name).image
    whole = path.read_bytes()
    path.write_bytes(whole[:100])
    reports = run_workspace(segmented)
    assert [(each.stage, each.failed) for each in reports if each.failed] == [
        ("segment", 1),
        ("semantic", 1),
    ]
    out = curate("status", "--failed", "-w", segmented.root)[1]
    assert f"round 0  segment  {name}" in out
    path.write_bytes(whole)
    assert run(segmented)["segment"] == 1


def test_workers_make_the_same_maps(
    segmented: Workspace, another: Callable[[Path], Workspace], tmp_path: Path, curate: Curate
) -> None:
    """Two processes, byte by byte."""
    other = another(tmp_path / "other").with_settings("segmenter", name=SEGMENTER)
    store(other)
    for place, workers in ((segmented, 1), (other, 2)):
        code, _, err = curate("segment", "-w", place.root, "--workers", workers)
        assert code == 0, err
    assert [path.read_bytes() for path in maps(other)] == [
        path.read_bytes() for path in maps(segmented)
    ]


def test_the_workspace_may_be_moved_with_its_maps(segmented: Workspace, tmp_path: Path) -> None:
    """The default folder is in the workspace."""
    run(segmented)
    calls(segmented)
    segmented.database.close()
    shutil.copytree(segmented.root, tmp_path / "moved")
    moved = Workspace.open(tmp_path / "moved")
    assert moved.config.segmenter.cache == tmp_path / "moved" / "maps"
    with closing(sqlite3.connect(tmp_path / "moved" / "curate.db")) as database, database:
        database.execute("DELETE FROM task")
    run(moved)
    assert calls(moved) == []


def test_a_relative_folder_starts_at_the_workspace(
    toy_kitti: Path, weights_file: Path, tmp_path: Path
) -> None:
    """As every path of curate.toml."""
    document = toy_document(toy_kitti, weights_file)
    document["segmenter"] |= {"name": SEGMENTER, "cache": "../shared-maps"}
    made = initialise(tmp_path / "work", make_config(document, "test"), "0.25", "")
    run(made)
    assert len(list((tmp_path / "shared-maps").glob("*/*/*.gz"))) == 6
