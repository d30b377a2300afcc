"""`curate suspects` on the toy frames: planted errors, held-out folds, tables and bad input."""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from support.pipelines_cli import Curate
from support.silent import Silent
from support.toys import toy_document

from pipelines.assessment.suspects import FoundSuspects, SuspectRequest, run_suspects, suspect_rows
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace


@pytest.fixture
def damaged(
    tmp_path: Path, toy_kitti: Path, weights_file: Path, new_url: Callable[[], str | None]
) -> Workspace:
    """Return a workspace of eight labeled and four val frames.

    In labeled frame 000001 a car is missing, in val frame 000009 a pedestrian is called a cyclist.
    """
    labels = toy_kitti / "training" / "label_2"
    lines = (labels / "000001.txt").read_text().splitlines()
    (labels / "000001.txt").write_text("\n".join(line for line in lines if line[:3] != "Car"))
    text = (labels / "000009.txt").read_text()
    (labels / "000009.txt").write_text(text.replace("Pedestrian", "Cyclist"))
    document = toy_document(toy_kitti, weights_file) | {"run": {"database": new_url()}}
    return initialise(tmp_path / "work", make_config(document, "test"), "1.0", "")


def find(workspace: Workspace, **request: object) -> tuple[FoundSuspects, list[str]]:
    """Return the suspects, and the stages that did something."""
    done: list[str] = []
    found = run_suspects(
        workspace,
        SuspectRequest(**{"minimum": 0.5, **request}),
        Silent(),
        lambda report: done.extend([report.stage] * bool(report.done)),
    )
    return found, done


def test_the_planted_errors_are_the_first_suspects(damaged: Workspace) -> None:
    """With the numbers of the label and of its files."""
    found, done = find(damaged)
    assert done == ["predict", "predict"]
    assert (found.labels, len(found.frames)) == (8 * 3 - 1 + 4 * 3, 12)
    assert "only as good as if it was not trained on them" in found.teachers
    rows = suspect_rows(damaged, found)
    planted = {(row["split"], row["frame"], row["category"]) for row in rows[:2]}
    assert planted == {("labeled", "000001", "Car"), ("val", "000009", "Cyclist")}
    of_val = next(row for row in rows if row["frame"] == "000009")
    assert (of_val["k"], of_val["predicted_category"]) == (1, "Pedestrian")
    assert "labeled Cyclist, predicted Pedestrian" in of_val["reason"]
    assert of_val["label_file"].endswith("label_2/000009.txt")
    assert find(damaged)[1] == []


def test_one_split_alone(damaged: Workspace) -> None:
    found, _ = find(damaged, splits=("val",))
    assert set(found.splits) == {"val"}


def test_a_trained_teacher_does_not_predict_the_frames_it_was_trained_on(
    damaged: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The labeled frames are predicted fold by fold, each in a workspace of its own."""
    monkeypatch.setattr("pipelines.assessment.suspects.is_trainable", lambda _: True)
    found, done = find(damaged, splits=("labeled",), folds=2)
    assert done == ["predict 1/2", "predict 2/2"]
    assert sorted(each.frame for each in found.frames) == sorted(damaged.frames("labeled"))
    assert "2 teachers, each trained without its fold" in found.teachers
    with damaged.database.reading() as connection:
        query = "SELECT count(*) FROM prediction"
        assert connection.exec_driver_sql(query).scalar_one() == 0


def test_the_command_writes_a_table_and_pictures(
    curate: Curate, damaged: Workspace, tmp_path: Path
) -> None:
    """A row per suspect with an empty column for the decision, and a close-up each."""
    table = tmp_path / "suspects.csv"
    code, out, err = curate(
        "suspects", "-w", damaged.root, "--pictures", "--output", table, "--minimum", 0.5
    )
    assert code == 0, err
    assert "of 35 labels" not in err
    assert "among 35 labels of 12 frames" in out
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert {row["decision"] for row in rows} == {""}
    for row in rows:
        assert (damaged.root / row["picture"]).read_bytes().startswith(b"\x89PNG")
    code, out, _ = curate("suspects", "-w", damaged.root, "--json", "--limit", 1)
    assert code == 0
    assert len(json.loads(out)["suspects"]) == 1


def test_an_unreadable_frame_is_left_out_with_a_warning(
    damaged: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    """The others are checked."""
    find(damaged)
    (damaged.dataset.files("000002").points).write_bytes(b"123")
    found, _ = find(damaged)
    assert len(found.frames) == 11
    assert "frame 000002 is left out" in caplog.text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--split", "unlabeled"), "--split unlabeled: use labeled, val or all"),
        (("--minimum", 2), "--minimum 2: must be from 0 to 1"),
        (("--round", 7), "--round 7: there is no such round; run.rounds is 3"),
        (("--round", 2), "round 2 has no teacher yet; run `curate train-round --round 1`"),
        (("--output", "/nowhere/table.csv"), "must be a file in an existing folder"),
    ],
)
def test_bad_input_is_reported_in_one_line(
    curate: Curate,
    damaged: Workspace,
    options: tuple,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if "--round" in options:  # an external detector predicts in every round
        monkeypatch.setattr("pipelines.engine.rounds.is_student_trained", lambda _: True)
    code, out, err = curate("suspects", "-w", damaged.root, *options)
    assert code != 0
    assert message in err
    assert err.count("\n") == 1
    assert not out


def test_frames_without_labels_and_too_many_folds(
    curate: Curate, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The advice depends on what there is."""
    monkeypatch.setattr("pipelines.assessment.suspects.is_trainable", lambda _: True)
    code, _, err = curate("suspects", "-w", workspace.root)
    assert (code, err) == (2, "error: --folds 5: there are 2 labeled frames; use 2 to 2\n")
    with workspace.database.writing() as connection:
        connection.exec_driver_sql("DELETE FROM ground_truth")
        connection.exec_driver_sql("DELETE FROM frame WHERE split <> 'unlabeled'")
    code, _, err = curate("suspects", "-w", workspace.root)
    assert code != 0
    assert err.startswith("error: there are no labeled or val frames")


def test_folds_of_a_single_labeled_frame(
    curate: Curate, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The advice is one that can be followed."""
    one = dict(list(workspace.frames("labeled").items())[:1])
    given = Workspace.frames
    splits = {"labeled": one}
    monkeypatch.setattr(Workspace, "frames", lambda self, name: splits.get(name, given(self, name)))
    monkeypatch.setattr("pipelines.assessment.suspects.is_trainable", lambda _: True)
    expected = "error: folds need 2 labeled frames, and there is only one; "
    _, _, err = curate("suspects", "-w", workspace.root)
    assert err == f"{expected}use --split val\n"
    splits["val"] = {}
    _, _, err = curate("suspects", "-w", workspace.root)
    assert err == f"{expected}label further frames\n"
