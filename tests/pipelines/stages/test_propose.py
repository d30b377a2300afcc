"""`curate propose` on the toy frames, and the review of its proposals."""

import csv
import json
import re
from pathlib import Path

import pytest
from support.car_masks import TRUTH
from support.pipelines_cli import Curate
from support.reviewed import advance, decide

from curate.errors import FramesFailed
from pipelines.workspace.workspace import Workspace

TRUE_CARS = "support.car_masks:TrueCars"


@pytest.fixture
def cars(workspace: Workspace) -> Workspace:
    """Return a workspace with a segmenter of cars, whose places are taken from the label files."""
    for name in workspace.dataset.frame_ids():
        truth = workspace.dataset.annotations(name)
        TRUTH[name] = truth.boxes[truth.categories == "Car"]
    path = workspace.root / "curate.toml"
    path.write_text(path.read_text().replace("support.toys:ToySegmenter", TRUE_CARS))
    return Workspace.open(workspace.root)


def stored(workspace: Workspace) -> list[tuple]:
    """Return round, category, provenance and points of the proposals."""
    query = "SELECT round, category, provenance, points FROM proposal ORDER BY frame_id, n"
    with workspace.database.reading() as connection:
        return [tuple(row) for row in connection.exec_driver_sql(query)]


def change(workspace: Workspace, statement: str) -> None:
    """Run a statement on the database."""
    with workspace.database.writing() as connection:
        connection.exec_driver_sql(statement)


def test_objects_without_a_label_are_proposed_reviewed_and_in_no_export(
    curate: Curate, cars: Workspace, tmp_path: Path
) -> None:
    """Cars whose labels have weight 0 are missed; accepted proposals become human labels."""
    advance(curate, cars, 1)
    options = ("-w", cars.root)
    code, _, err = curate("review", "export", tmp_path / "no", *options, "--by", "proposals")
    assert code != 0
    assert "run `curate propose --round 1`" in err
    change(cars, "UPDATE weight SET v = 0.9")
    assert curate("propose", *options)[0] == 0
    assert stored(cars) == []
    change(cars, "UPDATE weight SET v = 0")
    code, out, err = curate("propose", *options, "--json")
    assert code == 0, err
    found = json.loads(out)
    assert (found["round"], found["frames"], found["failed"]) == (1, 6, 0)
    assert found["categories"]["Car"] >= 3
    rows = stored(cars)
    assert {row[:3] for row in rows} == {(1, "Car", "proposal")}
    assert curate("propose", *options)[0] == 0
    assert stored(cars) == rows
    folder = tmp_path / "review"
    code, out, err = curate("review", "export", folder, *options, "--by", "proposals", "--json")
    assert code == 0, err
    assert json.loads(out)["asked"] == len(rows)
    with (folder / "review.csv").open() as file:
        row = next(row for row in csv.DictReader(file) if row["asked"])
    frame, k = row["frame"], row["k"]
    assert (k, row["score"], row["weight"]) == ("2000000", "", "")
    assert "are proposals of `curate propose`" in (folder / "README.txt").read_text()
    decide(folder, frame, int(k), "accept")
    code, out, err = curate("review", "import", folder, *options)
    assert code == 0, err
    assert "1 accepted" in out
    code, out, err = curate(
        "review", "export", tmp_path / "rest", *options, "--by", "proposals", "--json"
    )
    assert code == 0, err
    assert json.loads(out)["asked"] == len(rows) - 1
    assert curate("propose", *options)[0] == 0
    assert len(stored(cars)) == len(rows) - 1
    code, out, _ = curate(
        "query", "SELECT provenance, count(*) FROM weighted_labels GROUP BY 1", *options, "--csv"
    )
    assert "proposal" not in out
    assert "human,1" in out


def test_labeled_frames_lack_nothing(curate: Curate, cars: Workspace) -> None:
    """Every car has its label; without it, the car is proposed for round 0."""
    assert curate("propose", "-w", cars.root, "--split", "val")[0] == 0
    assert stored(cars) == []
    change(cars, "DELETE FROM ground_truth WHERE split = 'val' AND category = 'Car'")
    code, out, err = curate("propose", "-w", cars.root, "--split", "val")
    assert code == 0, err
    assert "proposed in 4 val frames, at image masks without ground truth" in out
    assert {row[0] for row in stored(cars)} == {0}


def test_a_frame_that_fails_keeps_its_proposals(curate: Curate, cars: Workspace) -> None:
    """The proposals of the others are replaced."""
    change(cars, "DELETE FROM ground_truth WHERE split = 'val' AND category = 'Car'")
    options = ("-w", cars.root, "--split", "val")
    assert curate("propose", *options)[0] == 0
    rows = stored(cars)
    change(cars, "UPDATE proposal SET points = 1")
    frame, key = next(iter(cars.frames("val").items()))
    change(cars, f"UPDATE proposal SET points = 2 WHERE frame_id = {key}")
    path = cars.dataset.files(frame).points
    path.write_bytes(path.read_bytes()[:50])
    code, _, err = curate("propose", *options)
    assert (code, "1 frames failed" in err) == (FramesFailed.exit_code, True)
    assert len(stored(cars)) == len(rows)
    counts = [row[3] for row in stored(cars)]
    assert 2 in counts
    assert 1 not in counts


def test_bad_input_is_reported_in_one_line(curate: Curate, cars: Workspace) -> None:
    """Before any frame is read."""
    path = cars.root / "curate.toml"
    text = path.read_text()

    def fails(message: str, *options: object) -> None:
        code, out, err = curate("propose", "-w", cars.root, *options)
        assert code != 0
        assert message in err
        assert err.count("\n") == 1
        assert not out

    fails("--split test: use one of", "--split", "test")
    fails("no round has predictions yet; run `curate run` or `curate predict`")
    fails("round 9 has no predictions", "--round", 9)
    fails("--policy: unknown policy 'luck'", "--round", 1, "--policy", "luck")
    path.write_text(text.replace(TRUE_CARS, "none"))
    fails("segmenter.name is 'none', and proposals are made from its masks")
    path.write_text(text)
    change(cars, "DELETE FROM ground_truth")
    fails("the labeled frames have no object of dataset.categories", "--split", "val")


def test_students_ignore_the_proposals_if_asked_to(
    curate: Curate, cars: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The training gets the regions of the round; the setting does not change the first teacher."""
    path = cars.root / "curate.toml"
    text = path.read_text().replace(
        "support.toys:ToyDetector", "support.trainable_toy:GridDetector"
    )
    text = re.sub(r"^path = .*detector.txt.*\n", "", text, count=1, flags=re.MULTILINE)
    text = re.sub(r"_steps = \d+", "_steps = 4", text)
    path.write_text(text)
    for command in ("pretrain", "predict", "repredict", "score", "solve"):
        code, _, err = curate(command, "-w", cars.root)
        assert code == 0, err
    from curate.training import trainer

    given = []
    train = trainer.train

    def recorded(*arguments: object, **options: object):
        given.append(options["regions"])
        return train(*arguments, **options)

    monkeypatch.setattr(trainer, "train", recorded)
    change(cars, "UPDATE weight SET v = 0")
    assert curate("export", "-w", cars.root, "--allow-empty")[0] == 0
    path.write_text(text.replace("ignore_proposals = false", "ignore_proposals = true"))
    code, out, _ = curate("pretrain", "-w", cars.root)
    assert "up to date" in out
    code, _, err = curate("train-round", "-w", cars.root, "--allow-empty", "--round", 1)
    assert code == 0, err
    [regions] = given
    boxes, categories = next(iter(regions.values()))
    assert set(regions) <= set(cars.frames("unlabeled"))
    assert boxes.shape == (1, 7)
    assert categories.tolist() == ["Car"]
    path.write_text(path.read_text().replace("support.car_masks:TrueCars", "none"))
    code, _, err = curate("train-round", "-w", cars.root, "--round", 1)
    assert code == 2
    assert "segmenter.name is 'none'" in err
