"""nuScenes through the pipeline: scenes stay whole, results get weights, labels become results."""

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
from support.nuscenes_scenes import (
    drawn_boxes,
    into_map,
    sample_token,
    vehicle_pose,
    write_nuscenes,
)
from support.pipelines_cli import Curate

from curate.datasets.nuscenes import NuScenesDataset
from curate.errors import ConfigError, LeakageError
from curate.geometry.similarity import Similarity
from pipelines.workspace.folds import open_folds
from pipelines.workspace.setup import choose_split
from pipelines.workspace.workspace import Workspace

SCENES = tuple(f"scene-{number:04d}" for number in (1, 2, 4, 5, 3, 12))
STEPS = 3
AS_IT_IS = Similarity()
TURN = Similarity(flip_y=True, rotation_rad=0.2, scale=1.02)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Return four scenes for training and two official ones of v1.0-trainval's val."""
    write_nuscenes(tmp_path / "nuscenes", SCENES, STEPS, "v1.0-trainval")
    return tmp_path / "nuscenes"


def tokens(*scenes: str) -> set[str]:
    """Return the frames of scenes."""
    return {sample_token(scene, step) for scene in scenes for step in range(STEPS)}


def write_results(path: Path, similarity: Similarity = AS_IT_IS) -> Path:
    """Write the detections of cars and pedestrians in nuScenes' format."""
    results = {}
    for number, scene in enumerate(SCENES):
        for step in range(STEPS):
            # A centimetre off: exact copies of the labels would be reported as a leak.
            boxes = np.add(drawn_boxes(number, step)[:2], [0.01, 0, 0, 0, 0, 0, 0])
            boxes = similarity.apply_to_boxes(boxes)
            placed = into_map(boxes, vehicle_pose(number, step))
            names = (("car", 0.8), ("pedestrian", 0.6))
            results[sample_token(scene, step)] = [
                box | {"detection_name": name, "detection_score": score, "velocity": [0, 0]}
                for box, (name, score) in zip(placed, names, strict=True)
            ]
    path.write_text(json.dumps({"meta": {}, "results": results}))
    return path


def test_a_share_takes_whole_scenes(root: Path, tmp_path: Path) -> None:
    """For labeled frames and for val, with any seed."""
    dataset = NuScenesDataset(root)
    for seed in range(5):
        split = choose_split(dataset, "0.3", "", seed)
        assert set(split.val) == tokens("scene-0003", "scene-0012")
        assert len(split.labeled) == STEPS
        for scene in SCENES:
            assert tokens(scene) & set(split.labeled) in (set(), tokens(scene))
    split = choose_split(dataset, "0.5", "0.25", 0)
    assert len(split.val) == STEPS
    assert len(split.labeled) in (STEPS, 2 * STEPS)
    (tmp_path / "labeled.txt").write_text("scene-0002\n")
    assert set(choose_split(dataset, str(tmp_path / "labeled.txt"), "", 0).labeled) == tokens(
        "scene-0002"
    )


def test_a_list_that_cuts_a_scene_is_rejected(root: Path, tmp_path: Path) -> None:
    """Neighbours show the same objects; an option allows it."""
    chosen = sample_token("scene-0001", 1)
    (tmp_path / "labeled.txt").write_text(chosen)
    arguments = (NuScenesDataset(root), str(tmp_path / "labeled.txt"), "", 0)
    with pytest.raises(LeakageError, match=r"scene-0001\) have frames in both labeled and unlab"):
        choose_split(*arguments)
    assert choose_split(*arguments, "frame").labeled == (chosen,)
    (tmp_path / "labeled.txt").write_text(f"scene-0002\n{chosen}")
    assert set(choose_split(*arguments, "frame").labeled) == tokens("scene-0002") | {chosen}


def test_recorded_results_become_weights_and_results(
    root: Path, tmp_path: Path, curate: Curate
) -> None:
    """On the command line: init, run, query, export; the export is a valid record again."""
    work = tmp_path / "work"
    plain = write_results(tmp_path / "plain.json")
    write_results(tmp_path / "turned.json", TURN)
    code, out, err = curate(
        "init", work, "--dataset", "nuscenes", "--root", root, "--labeled", "0.5",
        "--dataset-option", "version=v1.0-trainval", "--dataset-option", "minimum_points=2",
        "--detector", "recorded", "--detector-path", plain,
    )  # fmt: skip
    assert code == 0, err
    assert "6 labeled, 6 unlabeled and 6 val frames" in out
    config = (work / "curate.toml").read_text()
    passes = '{passes = [{path = "turned.json", flip_y = true, rotation_rad = 0.2, scale = 1.02}]}'
    section = config.index("[detector]")
    config = config[:section] + config[section:].replace("options = {}", f"options = {passes}", 1)
    (work / "curate.toml").write_text(config)
    code, _, err = curate("run", "-w", work)
    assert code == 0, err

    sql = "SELECT frame, category, score, points, loss, weight FROM weighted_labels"
    code, out, err = curate("query", sql, "-w", work, "--csv")
    assert code == 0, err
    rows = list(csv.DictReader(io.StringIO(out)))
    assert len(rows) == 12
    assert {row["category"] for row in rows} == {"Car", "Pedestrian"}
    assert all(int(row["points"]) >= 30 for row in rows)
    # Both passes agree, so only the score's part of the loss is left.
    expected = [-np.log(float(row["score"])) for row in rows]
    assert [float(row["loss"]) for row in rows] == pytest.approx(expected, abs=1e-6)
    assert max(float(row["weight"]) for row in rows) > 0

    code, out, err = curate("export", "--format", "nuscenes", "-w", work)
    assert code == 0, err
    found = json.loads((work / "exports" / "round-01-pspsl-nuscenes.json").read_text())
    given = json.loads(plain.read_text())["results"]
    assert len(found["results"]) == 6
    for token, kept in found["results"].items():
        assert found["ignored"][token] == []  # under pspsl weight 0 is background
        boxes = sorted(kept + found["background"][token], key=lambda box: box["k"])
        for box, right in zip(boxes, given[token], strict=True):
            np.testing.assert_allclose(box["translation"], right["translation"], atol=1e-6)
            np.testing.assert_allclose(box["size"], right["size"], atol=1e-9)
            assert abs(np.dot(box["rotation"], right["rotation"])) == pytest.approx(1, abs=1e-9)


def test_wrong_results_give_a_one_line_error(root: Path, tmp_path: Path, curate: Curate) -> None:
    """Tokens of another dataset, an option without a value."""
    arguments = ("init", tmp_path / "work", "--dataset", "nuscenes", "--root", root)
    code, _, err = curate(*arguments, "--dataset-option", "camera")
    assert code == ConfigError.exit_code
    assert "--dataset-option camera: give NAME=VALUE" in err
    (tmp_path / "a.json").write_text(json.dumps({"meta": {}, "results": {"x": []}}))
    named = ("--detector", "recorded", "--detector-path", tmp_path / "a.json")
    own = (
        "--labeled", "0.5", "--dataset-option", 'rename={car = "PKW"}',
        "--set", 'dataset.categories=["PKW", "bicycle"]',
    )  # fmt: skip
    assert curate(*arguments, *named, *own)[0] == 0
    _, out, _ = curate(
        "query", "SELECT DISTINCT category FROM ground_truth ORDER BY 1", "-w", tmp_path / "work"
    )
    assert "PKW" in out
    assert "bicycle" in out
    _, out, err = curate("doctor", "-w", tmp_path / "work")
    assert "results for frames that do not exist (x)" in out + err


def test_folds_do_not_cut_scenes(root: Path, tmp_path: Path, curate: Curate) -> None:
    """There are at most as many folds as scenes."""
    plain = write_results(tmp_path / "plain.json")
    code, _, err = curate(
        "init", tmp_path / "work", "--dataset", "nuscenes", "--root", root, "--labeled", "0.75",
        "--detector", "recorded", "--detector-path", plain,
    )  # fmt: skip
    assert code == 0, err
    workspace = Workspace.open(tmp_path / "work")
    folds = [set(fold.frames("val")) for fold in open_folds(workspace, 3)]
    assert sorted(map(len, folds)) == [STEPS] * 3
    for scene in SCENES:
        assert all(tokens(scene) & fold in (set(), tokens(scene)) for fold in folds)
    with pytest.raises(ConfigError, match="the labeled frames are from only 3 sequences"):
        list(open_folds(workspace, 4))
