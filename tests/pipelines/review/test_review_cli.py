"""`curate review`: export to an editor, import, and the effect of human decisions."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from support.exported import rows_of
from support.paths import ROOT
from support.pipelines_cli import Curate
from support.reviewed import (
    advance,
    corrected,
    decide,
    export_review,
    import_review,
    only_first,
)
from support.rounds import state_of
from support.stored_rows import rows
from support.stored_tuples import store

from curate.errors import DatabaseError
from curate.training.labels import WeightedLabels
from pipelines.labels.of_one_frame import read_frame
from pipelines.registry import EDITORS, POLICIES
from pipelines.stages.export import label_set
from pipelines.workspace.workspace import Workspace

LABELS = "SELECT frame, k, category, x, weight, provenance FROM weighted_labels "


def change(workspace: Workspace, sql: str) -> None:
    """Change the database without the pipeline."""
    with workspace.database.writing() as connection:
        connection.exec_driver_sql(sql)


def test_a_review_exports_whole_frames(curate: Curate, weighted: Workspace, tmp_path: Path) -> None:
    """The least certain first; with images, a table and a guide."""
    change(weighted, "UPDATE weight SET v = 0.9")
    change(weighted, "UPDATE weight SET v = 0.45 WHERE frame_id = 5 AND k = 1")
    name = rows(weighted, "SELECT frame FROM frame WHERE id = 5")[0][0]
    folder = tmp_path / "review"
    assert export_review(curate, weighted, folder, "--count", 1) == name
    table = (folder / "review.csv").read_text().splitlines()
    assert [line.split(",")[:3] for line in table[1:]] == [
        [name, "all", ""], [name, "0", ""], [name, "1", "yes"], [name, "2", ""],
    ]  # fmt: skip
    assert len((folder / "label_2" / f"{name}.txt").read_text().splitlines()) == 3
    assert (folder / "pictures" / f"{name}.png").stat().st_size > 10_000
    assert "accept" in (folder / "README.txt").read_text()


def test_lowest_and_changed_select_other_labels(
    curate: Curate, weighted: Workspace, tmp_path: Path
) -> None:
    """Lowest by weight; changed against the round before, by category."""
    change(weighted, "UPDATE weight SET v = 0.5")
    advance(curate, weighted, 2)
    change(weighted, "UPDATE weight SET v = 0.5 WHERE round = 2")
    change(weighted, "UPDATE weight SET v = 0.2 WHERE round = 2 AND frame_id = 4 AND k = 0")
    change(weighted, "UPDATE weight SET v = 1.0 WHERE round = 2 AND frame_id = 6 AND k = 0")
    names = dict(rows(weighted, "SELECT id, frame FROM frame"))
    one = ("--count", 1, "--by")
    assert export_review(curate, weighted, tmp_path / "a", *one, "lowest") == names[4]
    assert export_review(curate, weighted, tmp_path / "b", *one, "changed") == names[6]
    code, _, err = curate(
        "review", "export", tmp_path / "c", "-w", weighted.root, "--round", 1, "--by", "changed"
    )
    assert (code, "no previous round" in err) == (2, True)


def test_a_dry_run_stores_nothing(curate: Curate, weighted: Workspace, tmp_path: Path) -> None:
    """It prints what would be stored."""
    folder = tmp_path / "review"
    corrected(folder, export_review(curate, weighted, folder, "--count", 18))
    printed = import_review(curate, weighted, folder, "--dry-run")
    found = {
        name: printed[name] for name in ("accepted", "rejected", "moved", "added", "untouched")
    }
    assert found == {"accepted": 1, "rejected": 1, "moved": 1, "added": 1, "untouched": 15}
    assert (printed["dry_run"], printed["frames"]) == (True, 6)
    assert rows(weighted, "SELECT count(*) FROM human_label") == [(0,)]


def test_human_decisions_override_every_policy(
    curate: Curate, reviewed: tuple[Workspace, Path, str]
) -> None:
    """Accepted, moved and added labels have weight 1, rejected ones 0."""
    workspace, _, frame = reviewed
    # The recorded detections of the toy estimate no IoU, which 3dioumatch needs, and may have been
    # trained on every frame with ground truth, so that learned has nothing to learn from.
    for policy in set(POLICIES.classes) - {"3dioumatch", "learned"}:
        code, _, err = curate("solve", "--policy", policy, "-w", workspace.root)
        assert code == 0, err
        sql = f"WHERE policy = '{policy}' AND frame = '{frame}' ORDER BY k"
        found = [(row[1], row[4], row[5]) for row in rows(workspace, LABELS + sql)]
        by_k = {k: (weight, provenance) for k, weight, provenance in found}
        assert len(found) == len(by_k), policy
        assert by_k.pop(1, (0, "human")) == (0, "human"), policy
        assert by_k == {0: (1, "human"), 2: (1, "human"), 1_000_003: (1, "human")}, policy
        assert (
            len(rows(workspace, f"SELECT 1 FROM weight WHERE policy = '{policy}' AND v > 1")) == 0
        )


def test_policies_do_not_see_human_decisions(
    curate: Curate, weighted: Workspace, tmp_path: Path
) -> None:
    """The weights that they store are the same before and after."""
    before = rows(weighted, "SELECT * FROM weight ORDER BY frame_id, k")
    folder = tmp_path / "review"
    corrected(folder, export_review(curate, weighted, folder, *only_first(weighted)))
    import_review(curate, weighted, folder)
    change(weighted, "DELETE FROM task WHERE stage = 'solve'")
    assert curate("solve", "-w", weighted.root)[0] == 0
    assert rows(weighted, "SELECT * FROM weight ORDER BY frame_id, k") == before


def test_human_decisions_survive_later_rounds(
    curate: Curate, reviewed: tuple[Workspace, Path, str]
) -> None:
    """After the teacher changes, no object is labeled twice, and the rejected one stays."""
    workspace, _, frame = reviewed
    for command in ("predict", "repredict", "score"):
        assert curate(command, "-w", workspace.root, "--round", 2)[0] == 0
    change(workspace, "UPDATE prediction SET x = x + 0.15, yaw = 0.05 WHERE round = 2")
    assert curate("solve", "-w", workspace.root, "--round", 2)[0] == 0
    sql = f"WHERE frame = '{frame}' AND policy = 'pspsl' AND round = {{}} ORDER BY k"
    first, second = (rows(workspace, LABELS + sql.format(number)) for number in (1, 2))
    assert [row[:3] + row[4:] for row in second] == [row[:3] + row[4:] for row in first]
    objects = [row[3] for row in second if row[4] == 1]
    assert objects == [row[3] for row in first if row[4] == 1]
    assert second[1][3] == pytest.approx(first[1][3] + 0.15)
    sample = next(each for each in _exported(curate, workspace, 2) if each.frame_id == frame)
    assert sorted(sample.weights.tolist()) == [0, 1, 1, 1]


def _exported(curate: Curate, workspace: Workspace, number: int) -> WeightedLabels:
    assert curate("export", "-w", workspace.root, "--round", number)[0] == 0
    return WeightedLabels(workspace.root / "exports" / "labels.sqlite")


def test_an_import_makes_exports_stale(curate: Curate, weighted: Workspace, tmp_path: Path) -> None:
    """Files for trainers are written again; a file without human labels does not change."""
    assert curate("export", "-w", weighted.root)[0] == 0
    folder = tmp_path / "review"
    frame = export_review(curate, weighted, folder, *only_first(weighted))

    def state() -> str:
        return state_of(weighted, "export")

    assert state() == "done"
    corrected(folder, frame)
    import_review(curate, weighted, folder)
    assert state() == "stale"
    assert _exported(curate, weighted, 1).meta["round"] == "1"
    assert state() == "done"
    file = weighted.root / "exports" / "labels.sqlite"
    sql = "SELECT count(*) AS n FROM weighted_labels WHERE provenance = 'human'"
    assert json.loads(curate("query", sql, "--file", file, "--json")[1]) == [{"n": 4}]
    assert len(rows_of(label_set(weighted, 1, "pspsl"))) == 19


def test_a_decision_counts_from_the_reviewed_round_on(
    curate: Curate, weighted: Workspace, tmp_path: Path
) -> None:
    """Earlier rounds keep their training labels, unless an option includes them."""
    advance(curate, weighted, 2)
    folder = tmp_path / "review"
    corrected(folder, export_review(curate, weighted, folder, *only_first(weighted)))
    rounds = "SELECT DISTINCT round FROM weighted_labels WHERE provenance = 'human' ORDER BY 1"
    assert import_review(curate, weighted, folder)["from_round"] == 2
    assert rows(weighted, rounds) == [(2,)]
    assert import_review(curate, weighted, folder, "--from-round", 1)["changed"]
    assert rows(weighted, rounds) == [(1,), (2,)]


def test_a_repeated_import_changes_nothing(
    curate: Curate, reviewed: tuple[Workspace, Path, str]
) -> None:
    """Corrected files replace the earlier ones; clear removes all of it."""
    workspace, folder, frame = reviewed
    stored = "SELECT * FROM human_label ORDER BY n"
    before = rows(workspace, stored)
    assert not import_review(curate, workspace, folder)["changed"]
    assert rows(workspace, stored) == before
    decide(folder, frame, 2, "accept")
    path = folder / "label_2" / f"{frame}.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:2]) + "\n")
    assert import_review(curate, workspace, folder)["added"] == 0
    assert len(rows(workspace, stored)) == 3
    listed = json.loads(curate("review", "list", "-w", workspace.root, "--json")[1])
    assert [(each["accepted"], each["rejected"], each["moved"]) for each in listed] == [(1, 1, 1)]
    assert curate("review", "clear", "-w", workspace.root)[0] == 2
    code, out, _ = curate("review", "clear", "--frames", frame, "-w", workspace.root)
    assert (code, out[:2]) == (0, "3 ")
    assert rows(workspace, "SELECT count(*) FROM human_match") == [(0,)]
    assert {row[5] for row in rows(workspace, LABELS)} == {"detector"}


def test_a_later_review_overrides_an_earlier_one(
    curate: Curate, reviewed: tuple[Workspace, Path, str], tmp_path: Path
) -> None:
    """It shows human labels as such; one that is deleted there is then rejected."""
    workspace, _, frame = reviewed
    later = tmp_path / "later"
    export_review(curate, workspace, later, "--frames", frame)
    table = [line.split(",") for line in (later / "review.csv").read_text().splitlines()]
    assert [row[2] for row in table[2:]] == ["human"] * 3
    path = later / "label_2" / f"{frame}.txt"
    path.write_text("\n".join(path.read_text().splitlines()[1:]) + "\n")
    printed = import_review(curate, workspace, later)
    assert (printed["rejected"], printed["replaced"], printed["untouched"]) == (1, 1, 2)
    decisions = "SELECT decision FROM human_label ORDER BY n"
    assert rows(workspace, decisions) == [("rejected",), ("rejected",), ("moved",), ("added",)]


def test_every_format_works_in_both_directions(
    curate: Curate, weighted: Workspace, tmp_path: Path
) -> None:
    """Imported unchanged, nothing is decided; accepted, all of it, as it was exported."""
    name = next(iter(weighted.frames("unlabeled")))
    names = ", ".join(f"h.{name}" for name in ("x", "y", "z", "length", "width", "height", "yaw"))
    same = "JOIN prediction AS p ON p.frame_id = h.frame_id AND p.x = h.x AND p.yaw = h.yaw"
    for editor in EDITORS.classes:
        folder = tmp_path / f"in-{editor}"
        export_review(curate, weighted, folder, "--format", editor, "--frames", name)
        assert import_review(curate, weighted, folder)["untouched"] == 3, editor
        assert import_review(curate, weighted, folder, "--accept", name)["accepted"] == 3, editor
        assert len(rows(weighted, f"SELECT {names} FROM human_label AS h {same}")) == 3, editor
        assert curate("review", "clear", "--all", "-w", weighted.root)[0] == 0


def test_human_labels_are_marked_in_every_output(
    curate: Curate, reviewed: tuple[Workspace, Path, str]
) -> None:
    """explain, view, report and the named query."""
    workspace, _, frame = reviewed
    printed = [curate("explain", frame, k, "-w", workspace.root) for k in (0, 1, 1_000_003)]
    assert [code for code, _, _ in printed] == [0, 0, 0]
    accepted, rejected, added = (out for _, out, _ in printed)
    assert "accepted by ada" in accepted
    assert "pspsl alone gives" in accepted
    assert "rejected by ada" in rejected
    assert "recomputed" in rejected
    assert "differ" not in rejected
    assert "added by ada" in added
    other = list(workspace.frames("unlabeled"))[1]
    untouched = curate("explain", other, 0, "-w", workspace.root)[1]
    assert "differ" not in untouched
    found = read_frame(workspace, frame, 1, "pspsl")
    assert found.numbers.tolist() == [0, 1, 2, 1_000_003]
    assert found.weights.tolist() == [1, 0, 1, 1]
    assert found.decisions.tolist() == ["accepted", "rejected", "moved", "added"]
    assert curate("report", "-w", workspace.root)[0] == 0
    page = next((workspace.root / "reports").glob("*.html")).read_text()
    assert "1 accepted, 1 added, 1 moved, 1 rejected" in page
    queried = json.loads(curate("query", "--named", "human", "-w", workspace.root, "--json")[1])
    assert sum(row["objects"] for row in queried) == 3
    for arguments in (("solve", "--policy", "uniform"), ("report", "--policy", "uniform")):
        assert curate(*arguments, "-w", workspace.root)[0] == 0
    page = (workspace.root / "reports" / "round-01-uniform.html").read_text()
    assert "a person rejected it" in page


INVALID_SELECTIONS = (
    (("--frames", "{labeled}"), 5, "is not unlabeled"),
    (("--frames", "{val}"), 5, "is not unlabeled"),
    (("--frames", "999999"), 2, "--frames: there is no frame '999999'"),
    (("--category", "Tram"), 2, "--category Tram"),
    (("--by", "luck"), 2, "--by luck"),
    (("--format", "paint"), 2, "unknown editor 'paint'"),
    (("--round", 7), 6, "--round 7"),
    (("--policy", "uniform"), 6, "uniform has weighted no labels"),
    (("--policy", "luck"), 2, "--policy: unknown policy 'luck'"),
)


def test_an_impossible_selection_gives_a_one_line_error(
    curate: Curate, weighted: Workspace, tmp_path: Path
) -> None:
    """No folder is left."""
    names = {split: next(iter(weighted.frames(split))) for split in ("labeled", "val")}
    for options, code, message in INVALID_SELECTIONS:
        words = [str(option).format(**names) for option in options]
        ended, _, err = curate("review", "export", tmp_path / "r", "-w", weighted.root, *words)
        assert (ended, message in err, err.count("\n")) == (code, True, 1), err
        assert not (tmp_path / "r").exists()


def spoil_text(folder: Path, frame: str) -> None:
    """Cut off a line."""
    path = folder / "label_2" / f"{frame}.txt"
    path.write_text(path.read_text()[:60])


def spoil_both(folder: Path, frame: str) -> None:
    """Write the same object twice."""
    path = folder / "label_2" / f"{frame}.txt"
    decide(folder, frame, 0, "accept")
    path.write_text(path.read_text() + path.read_text().splitlines()[0] + "\n")


INVALID_EDITS = (
    (lambda folder, frame: (folder / "review.json").unlink(), (), "review.json: no such file"),
    (spoil_text, (), "fields, but label lines"),
    (spoil_both, (), "cannot overlap: reject one of label 0 ("),
    (lambda folder, frame: decide(folder, frame, 0, "perhaps"), (), "decision 'perhaps'"),
    (lambda folder, frame: None, ("--answer", "nowhere"), "nowhere: no such folder"),
    (
        lambda folder, frame: None,
        ("--accept", "000099"),
        "in this review: there is no frame '000099'; the near",
    ),
)


def test_an_invalid_import_gives_one_line_and_stores_nothing(
    curate: Curate, weighted: Workspace, tmp_path: Path
) -> None:
    """Not even the valid half; an existing folder is not changed."""
    whole = tmp_path / "review"
    frame = export_review(curate, weighted, whole, *only_first(weighted))
    decide(whole, frame, 1, "accept")
    for number, (spoil, options, message) in enumerate(INVALID_EDITS):
        folder = tmp_path / str(number)
        shutil.copytree(whole, folder)
        spoil(folder, frame)
        code, _, err = curate("review", "import", folder, "-w", weighted.root, *options)
        assert (code in {2, 3}, message in err, err.count("\n")) == (True, True, 1), err
    assert rows(weighted, "SELECT count(*) FROM human_label") == [(0,)]
    code, _, err = curate("review", "export", whole, "-w", weighted.root)
    assert (code, "may contain edits" in err) == (2, True)
    change(weighted, "DELETE FROM review")
    code, _, err = curate("review", "import", whole, "-w", weighted.root)
    assert (code, "was not exported from the workspace" in err) == (3, True)


def test_only_unlabeled_frames_can_have_human_labels(weighted: Workspace) -> None:
    """The table itself rejects others."""
    change(weighted, "INSERT INTO review VALUES ('r', 1, 'pspsl', 'kitti', 1, 1, 1, 'now', NULL)")
    for split in ("labeled", "val"):
        key = next(iter(weighted.frames(split).values()))
        for claimed in (split, "unlabeled"):
            row = (key, 0, claimed, "r", None, "added", "Car", 1, *[1.0] * 7, *[None] * 7, "a", "n")
            with pytest.raises(DatabaseError), weighted.database.writing() as connection:
                store(connection, "human_label", [row])


def test_a_killed_import_stores_nothing(
    curate: Curate, weighted: Workspace, tmp_path: Path
) -> None:
    """Killed between the labels and their task; the same import then does all of it."""
    folder = tmp_path / "review"
    corrected(folder, export_review(curate, weighted, folder, *only_first(weighted)))
    code = (
        "import os, signal, sys\n"
        "from pipelines.review import importing\n"
        "def die(*_): os.kill(os.getpid(), signal.SIGKILL)\n"
        "importing.refresh_all_matches = die\n"
        "from pipelines.cli import main\n"
        f"sys.argv = ['curate', 'review', 'import', {str(folder)!r}]\n"
        f"sys.argv += ['-w', {str(weighted.root)!r}]\n"
        "main()\n"
    )
    paths = os.pathsep.join((str(ROOT), str(ROOT / "tests")))
    ended = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": paths}, check=False
    )
    assert ended.returncode == -signal.SIGKILL
    assert rows(weighted, "SELECT count(*) FROM human_label") == [(0,)]
    assert import_review(curate, weighted, folder)["moved"] == 1
    assert rows(weighted, "SELECT count(*) FROM human_label") == [(4,)]
