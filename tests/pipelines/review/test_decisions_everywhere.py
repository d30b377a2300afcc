"""Every place that shows or counts labels shows what people decided about them."""

import json
import pickle
import re
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from support.pipelines_cli import Curate
from support.stored_rows import rows

from curate.exporters.base import WEIGHTED_LABEL_COLUMNS
from curate.viewing.palette import DARK
from pipelines.labels.of_one_frame import read_frame
from pipelines.reports.pictures import frame_picture
from pipelines.workspace.config_file import write_config
from pipelines.workspace.workspace import Workspace

Reviewed = tuple[Workspace, Path, str]
# Label 0 was accepted, 1 rejected, 2 moved, and a cyclist added.
DECISIONS = {0: "accepted", 1: "rejected", 2: "moved", 1_000_003: "added"}
WEIGHTS = [1, 0, 1, 1]


def printed(curate: Curate, workspace: Workspace, *arguments: object) -> str:
    """Run a command in a workspace and return what it printed."""
    code, out, err = curate(*arguments, "-w", workspace.root)
    assert code == 0, err
    return out


def queried(curate: Curate, workspace: Workspace, name: str) -> list[dict]:
    """Return the rows of a named query."""
    return json.loads(printed(curate, workspace, "query", "--named", name, "--json"))


def test_named_queries_show_decisions(curate: Curate, reviewed: Reviewed) -> None:
    """How many labels people decided, or which labels they decided."""
    workspace, _, frame = reviewed
    for name in ("kept", "policies", "counts"):
        assert sum(row["human"] for row in queried(curate, workspace, name)) == 4, name
    [trusted] = [row for row in queried(curate, workspace, "trusted-frames")
                 if row["frame"] == frame]  # fmt: skip
    assert (trusted["trusted"], trusted["human"]) == (3, 3)
    for row in queried(curate, workspace, "human"):
        assert row["objects"] + row["rejected"] > 0
    doubted = queried(curate, workspace, "doubted")
    assert [row["provenance"] for row in doubted if (row["frame"], row["k"]) == (frame, 1)] == [
        "human"
    ]


def test_the_status_counts_decisions(curate: Curate, reviewed: Reviewed) -> None:
    """A row with the frames, and a line with the decisions; without any, neither is there."""
    workspace, _, _ = reviewed
    found = json.loads(printed(curate, workspace, "status", "--json"))
    [row] = [row for row in found if row["stage"] == "review"]
    assert (row["round"], row["split"], row["done"], row["waiting"]) == (1, "unlabeled", 1, 0)
    line = "round 1: decisions of people: 1 accepted, 1 added, 1 moved, 1 rejected"
    assert line in printed(curate, workspace, "status")
    printed(curate, workspace, "review", "clear", "--all")
    assert "review" not in printed(curate, workspace, "status")


def test_the_report_counts_decisions(curate: Curate, reviewed: Reviewed) -> None:
    """The comparison of policies, too: the same labels and decisions under each."""
    workspace, _, _ = reviewed
    assert curate("solve", "--policy", "uniform", "-w", workspace.root)[0] == 0
    out = printed(curate, workspace, "report")
    page = (workspace.root / "reports" / "round-01-pspsl.html").read_text()
    assert "round-01-pspsl.html" in out
    rows_of_table = page.split("Comparison with other policies")[1].split("</table>")[0]
    cells = [re.findall(r"<td[^>]*>([^<]*)</td>", row) for row in rows_of_table.split("<tr>")[2:]]
    expected = {
        name: [str(labels), str(kept), str(trusted)]
        for name, labels, kept, trusted in rows(
            workspace,
            "SELECT policy, count(*), sum(weight > 0), sum(weight > 0.5) FROM weighted_labels "
            "GROUP BY policy",
        )
    }
    assert {row[0].split()[0]: row[1:4] for row in cells} == expected
    assert [row[-1] for row in cells] == ["4", "4"]


def test_view_all_draws_a_frame_that_only_a_person_labeled(
    curate: Curate, reviewed: Reviewed
) -> None:
    """It has labels, though no prediction."""
    workspace, _, frame = reviewed
    key = workspace.frames("unlabeled")[frame]
    with workspace.database.writing() as connection:
        for table in ("reprediction", "prediction"):
            connection.exec_driver_sql(f"DELETE FROM {table} WHERE frame_id = {key}")
    printed(curate, workspace, "view", "--all")
    assert (workspace.root / "pictures" / f"round-01-{frame}-pspsl.png").is_file()


def test_view_lists_decisions(curate: Curate, reviewed: Reviewed) -> None:
    """As text and as JSON, also for a frame that is named by its number."""
    workspace, _, frame = reviewed
    out = printed(curate, workspace, "view", str(int(frame)))
    assert (
        f"frame {frame}: decisions of people: k0 accepted, k1 rejected, k2 moved, "
        "k1000003 added" in " ".join(out.split())
    )
    assert (workspace.root / "pictures" / f"round-01-{frame}-pspsl.png").is_file()
    found = json.loads(printed(curate, workspace, "view", frame, "--json"))["decisions"]
    assert {each["k"]: each["decision"] for each in found} == DECISIONS
    assert {each["frame"] for each in found} == {frame}
    other = next(name for name in workspace.frames("unlabeled") if name != frame)
    assert json.loads(printed(curate, workspace, "view", other, "--json"))["decisions"] == []
    assert "decisions of" not in printed(curate, workspace, "view", other)


def test_pictures_show_decisions(curate: Curate, reviewed: Reviewed) -> None:
    """The person's box and not the prediction, with long dashes; a rejected label has a cross."""
    workspace, _, frame = reviewed

    def pixels() -> int:
        drawn = frame_picture(workspace, frame, 1, "pspsl").astype(int)
        above = drawn[:-60]  # without the legend
        return int((np.abs(above - np.array(DARK.human)).max(axis=2) < 12).sum())

    found = read_frame(workspace, frame, 1, "pspsl")
    assert dict(zip(found.numbers.tolist(), found.decisions.tolist(), strict=True)) == DECISIONS
    assert found.weights.tolist() == WEIGHTS
    seen = rows(workspace, "SELECT x, seen_x FROM human_label WHERE decision = 'moved'")[0]
    assert found.labels.boxes[2, 0] == seen[0] != seen[1]
    every = pixels()
    with workspace.database.writing() as connection:
        connection.exec_driver_sql("DELETE FROM human_label WHERE decision <> 'rejected'")
        connection.exec_driver_sql("DELETE FROM human_match WHERE k <> 1")
    rejected = pixels()
    printed(curate, workspace, "review", "clear", "--all")
    assert every - 50 > rejected > pixels()


def test_a_rejected_label_is_explained_as_rejected(curate: Curate, reviewed: Reviewed) -> None:
    """Its line `weight` is the person's; a replaced prediction leads to the person's label."""
    workspace, _, frame = reviewed
    out = printed(curate, workspace, "explain", frame, 1)
    assert "\n  weight " not in out
    assert "\n  policy weight " in out
    assert out.rstrip().endswith(": weight 0")
    with workspace.database.writing() as connection:
        connection.exec_driver_sql(
            "UPDATE human_match SET n = 0, leads = 0 WHERE k = 1 AND round = 1"
        )
    code, _, err = curate("explain", frame, 1, "-w", workspace.root)
    assert code == 6
    assert f"label 1 of frame {frame} is replaced by label 0, which a person decided" in err


@pytest.mark.parametrize("file_format", ["kitti", "coco", "openpcdet", "mmdet3d", "st3d", "csv"])
def test_every_export_holds_the_decisions(
    curate: Curate, reviewed: Reviewed, tmp_path: Path, file_format: str
) -> None:
    """k, provenance and weight; a rejected label is never an object, and never ignored."""
    workspace, _, frame = reviewed
    path = tmp_path / "exported"
    ignoring = workspace.with_settings("train", zero_weight="ignore").config
    write_config(workspace.root / "curate.toml", ignoring)
    printed(curate, workspace, "export", "--format", file_format, "--output", path)
    found = READERS[file_format](path, frame)
    expected = dict(zip(DECISIONS, WEIGHTS, strict=True))
    if file_format == "st3d":  # which leaves background out
        del expected[1]
    assert found == {k: ("human", weight) for k, weight in expected.items()}


def read_kitti(path: Path, frame: str) -> dict:
    """Return provenance and weight by k; the rejected label has no line in label_2."""
    lines = (path / "provenance" / f"{frame}.txt").read_text().splitlines()
    weights = (path / "weight" / f"{frame}.txt").read_text().splitlines()
    assert len((path / "label_2" / f"{frame}.txt").read_text().splitlines()) == 3
    assert len(list((path / "provenance").iterdir())) == 1
    return {
        int(line.split()[0]): (line.split()[1], float(weight.split()[1]))
        for line, weight in zip(lines, weights, strict=True)
    }


def read_coco(path: Path, frame: str) -> dict:
    """Return provenance and weight by k; the rejected label is background."""
    document = json.loads(path.read_text())
    assert [each["k"] for each in document["background"] if each["frame"] == frame] == [1]
    every = [*document["annotations"], *document["background"]]
    return {e["k"]: (e["provenance"], e["weight"]) for e in every if e["frame"] == frame}


def read_openpcdet(path: Path, frame: str) -> dict:
    """Return provenance and weight by k; the rejected label is a DontCare, not ignored."""
    infos = pickle.loads((path / "kitti_infos_train.pkl").read_bytes())
    [annos] = [info["annos"] for info in infos if info["image"]["image_idx"] == frame]
    rejected = annos["k"] == 1
    assert annos["name"][rejected].tolist() == ["DontCare"]
    assert not annos["ignored"][rejected].any()
    columns = (annos[name].tolist() for name in ("k", "provenance", "weight"))
    return {k: (provenance, weight) for k, provenance, weight in zip(*columns, strict=True)}


def read_mmdet3d(path: Path, frame: str) -> dict:
    """Return provenance and weight by k."""
    infos = pickle.loads((path / "kitti_infos_train.pkl").read_bytes())["data_list"]
    [found] = [info["instances"] for info in infos if info["frame"] == frame]
    assert [each["bbox_label_3d"] for each in found if each["k"] == 1] == [-1]
    return {each["k"]: (each["provenance"], each["weight"]) for each in found}


def read_st3d(path: Path, frame: str) -> dict:
    """Return provenance and weight by k."""
    found = pickle.loads((path / "ps_label_e0.pkl").read_bytes())[frame]
    columns = (found[name].tolist() for name in ("k", "provenance", "weight"))
    return {k: (provenance, weight) for k, provenance, weight in zip(*columns, strict=True)}


def read_csv(path: Path, frame: str) -> dict:
    """Return provenance and weight by k."""
    lines = [line.split(",") for line in path.read_text().splitlines()]
    places = [WEIGHTED_LABEL_COLUMNS.index(name) for name in ("k", "provenance", "weight")]
    own = [line for line in lines[1:] if line[1] == frame]
    return {int(row[k]): (row[p], float(row[w])) for k, p, w in [places] for row in own}


READERS = {
    "kitti": read_kitti, "coco": read_coco, "openpcdet": read_openpcdet, "mmdet3d": read_mmdet3d,
    "st3d": read_st3d, "csv": read_csv,
}  # fmt: skip


def test_the_page_of_a_frame_shows_decisions(
    curate: Curate, reviewed: Reviewed, tmp_path: Path
) -> None:
    """The table has the labels of `weighted_labels`; the picture follows a later decision."""
    pytest.importorskip("datasette", reason="the extra [serve] is not installed")
    from support.serving import running

    from pipelines.serving.sources import choose

    workspace, _, frame = reviewed
    with running(choose(workspace.root, None, None), workspace) as pages:
        page = pages.get("/-/frame", frame=frame, k=1_000_003)
        assert page.status == 200
        assert "4 labels, 4 of them decided by people" in page.text
        for k, decision in DECISIONS.items():
            row = page.text.split(f"k={k}#label")[1].split("</tr>")[0]
            assert f"<td>{decision}</td>" in row
            weight = "0" if decision == "rejected" else "1"
            assert row.rstrip().endswith(f"<td>{weight}</td>")
        assert '<tr class="rejected">' in page.text
        assert "added by ada" in page.text
        before = pages.get("/-/picture", frame=frame).body
        printed(curate, workspace, "review", "clear", "--all")
        assert pages.get("/-/picture", frame=frame).body != before
        page = pages.get("/-/frame", frame=frame)
        assert "decided by people" not in page.text
        assert "decision" not in page.text


def test_a_view_of_another_round_shows_only_its_decisions(
    curate: Curate, reviewed: Reviewed
) -> None:
    """A decision that counts from round 2 on is not shown in round 1."""
    workspace, folder, frame = reviewed
    printed(curate, workspace, "review", "import", folder, "--from-round", 2, "--reviewer", "ada")
    assert json.loads(printed(curate, workspace, "view", frame, "--json"))["decisions"] == []
    assert not (read_frame(workspace, frame, 1, "pspsl").decisions != "").any()


@pytest.mark.parametrize("name", ["{number}", "{frame}.bin", "velodyne/{frame}.png", "0{frame}"])
def test_a_frame_has_several_spellings(curate: Curate, reviewed: Reviewed, name: str) -> None:
    """For `explain` and `view`."""
    workspace, _, frame = reviewed
    spelled = name.format(number=int(frame), frame=frame)
    assert f"frame {frame}, label 2" in printed(curate, workspace, "explain", spelled, 2)
    assert f"-{frame}-" in printed(curate, workspace, "view", spelled)


def test_an_unknown_frame_gets_a_suggestion(curate: Curate, reviewed: Reviewed) -> None:
    """The nearest name."""
    workspace, _, frame = reviewed
    for command in (("explain", f"1{frame}x", 0), ("view", f"1{frame}x")):
        code, _, err = curate(*command, "-w", workspace.root)
        assert code == 2
        assert f"there is no frame '1{frame}x'; the nearest are '" in err


def test_the_working_database_and_an_export_have_the_same_decisions(
    curate: Curate, reviewed: Reviewed
) -> None:
    """The view and the exported file."""
    workspace, _, frame = reviewed
    printed(curate, workspace, "export")
    query = (
        f"SELECT k, provenance, weight, x FROM weighted_labels WHERE frame = '{frame}' "
        "AND policy = 'pspsl' ORDER BY k"
    )
    with closing(sqlite3.connect(workspace.root / "exports" / "labels.sqlite")) as connection:
        assert connection.execute(query).fetchall() == [tuple(r) for r in rows(workspace, query)]
