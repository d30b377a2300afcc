"""What an evaluation leaves out is said: counts, reasons, nulls, and levels without images."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.lidar_only import LidarOnly, write_lidar_only
from support.pipelines_cli import Curate
from support.terminals import terminal
from support.toys import toy_calibration

from curate.datasets.kitti.calibration import write_calibration
from curate.datasets.kitti.dataset import KittiDataset
from curate.errors import ConfigError, DataError
from curate.frames import Frame
from pipelines.workspace.workspace import Workspace

NAMES = ("Car", "Pedestrian", "Cyclist")
FULL = [100.0] * 3


@pytest.fixture
def made(tmp_path: Path) -> LidarOnly:
    """Return six frames with labels without 2D boxes, and correct results."""
    return write_lidar_only(tmp_path)


@pytest.fixture
def work(made: LidarOnly, tmp_path: Path, curate: Curate) -> Path:
    """Return a workspace of these frames with stored val predictions; 2 labeled, 4 val frames."""
    names = [f"{i:06d}\n" for i in range(made.frames)]
    (tmp_path / "two.txt").write_text("".join(names[:2]))
    (tmp_path / "four.txt").write_text("".join(names[2:]))
    init(curate, tmp_path, made, tmp_path / "w")
    return tmp_path / "w"


def init(curate: Curate, lists: Path, made: LidarOnly, work: Path, *more: object) -> None:
    """Create a workspace with recorded results, without repredictions, and predict on val."""
    code, _, err = curate(
        *("init", work, "--root", made.root, "--detector", "recorded"),
        *("--labeled", lists / "two.txt", "--val", lists / "four.txt"),
        *("--detector-path", made.results),
        *("--set", "solve.self_paced=false", "--set", 'run.priors=["points"]', *more),
    )
    assert code == 0, err
    assert curate("predict", "--split", "val", "-w", work)[0] == 0


def evaluate(curate: Curate, labels: Path, results: Path, *more: object) -> dict:
    """Return the JSON output for two folders."""
    code, out, err = curate("evaluate", "--labels", labels, "--results", results, "--json", *more)
    assert code == 0, err
    return json.loads(out, parse_constant=pytest.fail)


def compiled(err: str) -> str:
    """Return standard error without the line about kernels that the first test compiles."""
    return err.replace("compiling the evaluation code (first use only, some seconds)\n", "")


def test_labels_without_2d_boxes_give_no_figure_and_say_why(
    curate: Curate, made: LidarOnly, tmp_path: Path
) -> None:
    """Without a calibration: 18 objects, none counts; every figure is null or "-"."""
    labels = made.alone(tmp_path / "alone")
    found = evaluate(curate, labels, made.results)
    for category in NAMES:
        nulls = dict.fromkeys(("image", "aos", "bev", "3d"), [None] * 3)
        assert found["AP_R40"][category] == found["AP_R11"][category] == nulls
        assert set(map(tuple, found["recall_3d"][category].values())) == {(None,) * 3}
        assert found["objects"][category] == [0, 0, 0]
        assert found["counts"]["objects"]["categories"][category] == {
            "total": 6,
            "counted": [0, 0, 0],
            "ignored": {"no 2D box": [6, 6, 6]},
        }
    [note] = found["notes"]
    assert note.startswith(
        "None of the 18 objects of Car, Pedestrian, Cyclist counts: 18 no 2D box"
    )
    assert "--calib" in note
    assert "--difficulty distance" in note
    code, out, _ = curate("evaluate", "--labels", labels, "--results", made.results)
    assert code == 0
    assert note in out
    rows = [line.split() for line in out.splitlines()]
    assert ["Car", "3d", *["-"] * 6] in rows
    assert ["Car", "objects", "6", "0", "0", "0", *["no", "2D", "box", "6/6/6"]] in rows
    assert "0.00" not in out


def test_a_calibration_gives_the_2d_boxes(curate: Curate, made: LidarOnly, tmp_path: Path) -> None:
    """Beside the labels it is used without an option; elsewhere with --calib."""
    beside = evaluate(curate, made.labels, made.results)
    training = made.root / "training"
    labels = made.alone(tmp_path / "alone")
    calib = ("--calib", training / "calib")
    given = evaluate(curate, labels, made.results, *calib, "--images", training / "image_2")
    sized = evaluate(curate, labels, made.results, *calib, "--image-size", "1200x400")
    assert beside == given == sized
    for category in NAMES:
        by_figure = beside["AP_R40"][category]
        assert by_figure["image"] == by_figure["bev"] == by_figure["3d"] == FULL
        assert by_figure["aos"] == pytest.approx(FULL)
    assert beside["notes"] == ["2D boxes from the projected 3D boxes: 18 of 18 objects without one"]
    unsized = evaluate(curate, labels, made.results, *calib)
    assert unsized["objects"]["Car"] == [0, 0, 0]


def test_results_without_2d_boxes_are_projected_too(curate: Curate, made: LidarOnly) -> None:
    """The same figures; without a calibration there is none, and AP is not 0."""
    for path in made.results.iterdir():
        rows = [line.split() for line in path.read_text().splitlines()]
        path.write_text("".join(" ".join([*r[:4], *"0000", *r[8:]]) + "\n" for r in rows))
    found = evaluate(curate, made.labels, made.results)
    assert found["AP_R40"]["Car"]["3d"] == FULL
    assert "18 of 18 objects without one and 18 of 18 results without one" in found["notes"][0]
    made.rewrite_labels(" 0 0 0 0 0 0 0 ", " 0 0 0 100 100 180 160 ")
    for path in (made.root / "training" / "calib").iterdir():
        path.unlink()
    bare = evaluate(curate, made.labels, made.results)
    assert bare["objects"]["Car"] == [6, 6, 6]
    assert bare["AP_R40"]["Car"]["3d"] == bare["recall_3d"]["Car"]["0.7"] == [None] * 3
    assert "None of the 18 results" in bare["notes"][-1]


def test_in_a_workspace_the_2d_boxes_are_projected(curate: Curate, work: Path) -> None:
    """BEV and 3D AP are 100, and the database has the same figures."""
    code, out, err = curate("evaluate", "--round", "1", "--json", "--store", "-w", work)
    assert (code, compiled(err)) == (0, "")
    found = json.loads(out, parse_constant=pytest.fail)
    for category in NAMES:
        assert found["AP_R40"][category]["bev"] == found["AP_R40"][category]["3d"] == FULL
        assert found["counts"]["results"]["categories"][category]["counted"][2] == 4
    sql = "SELECT category, figure, difficulty, ap_r40 FROM evaluation_ap"
    rows = json.loads(curate("query", sql, "--json", "-w", work)[1])
    assert len(rows) == 3 * 4 * 3
    assert {row["ap_r40"] for row in rows} == {100.0}


def test_the_audit_counts_and_does_not_invent_figures(curate: Curate, work: Path) -> None:
    """All labels are correct: no AUROC. What needs repredictions was not measured: null."""
    code, out, _ = curate("audit", "-w", work, "--json", "--replicates", "20")
    assert code == 0
    found = json.loads(out, parse_constant=pytest.fail)
    for side in ("objects", "labels"):
        assert found["counts"][side]["total"] == 12
        for category in NAMES:
            counted = {"total": 4, "counted": [4], "ignored": {}}
            assert found["counts"][side]["categories"][category] == counted
    assert found["unmeasured"] == ["spsl", "consistency"]
    assert found["thresholds"] == {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}
    for each in found["figures"]:
        assert each["auroc"]["value"] is None
        if each["policy"] in found["unmeasured"]:
            names = ("average_precision", "weighted_precision", "weighted_recall")
            assert all(each[name]["value"] is None for name in (*names, "calibration_error"))
    sql = "SELECT policy, weighted_recall, calibration_error FROM audit WHERE category = 'all'"
    rows = {row.pop("policy"): row for row in json.loads(
        curate("query", sql, "--json", "-w", work)[1])}  # fmt: skip
    assert rows["spsl"] == {"weighted_recall": None, "calibration_error": None}
    assert rows["uniform"] == {"weighted_recall": 1.0, "calibration_error": 0.0}
    _, out, _ = curate("audit", "-w", work, "--replicates", "20")
    ranking, by_part = (
        out.partition(title)[2].partition("\n\n")[0]
        for title in ("ranking of the labels by weight", "AUROC by part")
    )
    assert {line.split()[1] for line in ranking.splitlines()[3:]} == {"-"}  # the AUROC
    assert ranking.count("\n") == 9
    assert "distance 20-40 m" in by_part
    assert not re.search(r"\d\.\d{3}", by_part)
    assert "Not measured: spsl, consistency, because no augmented copy" in out
    lines = [line.split() for line in out.splitlines()]
    assert lines.count(["spsl", *["-"] * 4]) == 2  # ranking, calibration
    assert lines.count(["spsl", *["-"] * 5]) == 1  # weight on correct labels
    assert ["Car", "labels", "4", "4"] in lines


def test_wrong_labels_without_repredictions_have_no_auroc_of_one_half(
    curate: Curate, made: LidarOnly, work: Path
) -> None:
    """With correct and wrong labels, "consistency" and "spsl" printed 0.500."""
    for path in made.results.iterdir():
        lines = path.read_text().splitlines()
        moved = lines[0].split()
        moved[11], moved[15] = "30.0", "0.3"
        path.write_text("\n".join([*lines, " ".join(moved)]) + "\n")
    _, out, _ = curate("audit", "-w", work, "--replicates", "20", "--json")
    found = json.loads(out)
    aurocs = {
        each["policy"]: each["auroc"]["value"]
        for each in found["figures"]
        if each["category"] == each["slice"]["by"] == "all"
    }
    assert aurocs.pop("spsl") is aurocs.pop("consistency") is None
    assert aurocs["uniform"] == 0.5  # equal weights rank by chance
    assert aurocs["score"] == 1


def test_without_priors_their_product_is_not_a_figure(
    curate: Curate, made: LidarOnly, work: Path, tmp_path: Path
) -> None:
    """rho_det is 1 for every label then, and says nothing."""
    init(curate, work.parent, made, tmp_path / "bare", "--set", "run.priors=[]")
    _, out, _ = curate("audit", "-w", tmp_path / "bare", "--json", "--replicates", "20")
    assert "rho_det" in json.loads(out)["unmeasured"]


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (" 0 0 0 0 0 0 0 ", " 0 3 0 100 100 180 160 ", "occluded"),
        (" 0 0 0 0 0 0 0 ", " 1 0 0 100 100 180 160 ", "truncated"),
        (" 0 0 0 0 0 0 0 ", " 0 0 0 100 100 180 110 ", "too small"),
    ],
)
def test_other_reasons_are_given_with_what_to_do(
    curate: Curate, made: LidarOnly, old: str, new: str, reason: str
) -> None:
    """Occluded or truncated beyond the limits, too small."""
    made.rewrite_labels(old, new)
    found = evaluate(curate, made.labels, made.results)
    assert f"18 {reason}; --difficulty points or distance" in found["notes"][-1]
    far = evaluate(curate, made.labels, made.results, "--difficulty", "distance")
    assert far["AP_R40"]["Pedestrian"]["3d"] == [100.0, None, None]


def test_other_categories_are_counted(curate: Curate, made: LidarOnly) -> None:
    """Neighbours, categories that are not evaluated, DontCare; together they are all objects."""
    made.rewrite_labels("Pedestrian", "Tram")
    made.rewrite_labels("Cyclist", "Van")
    with (made.labels / "000000.txt").open("a") as file:
        file.write("DontCare -1 -1 -10 5 5 90 90 -1 -1 -1 -1000 -1000 -1000 -10\n")
    found = evaluate(curate, made.labels, made.results)["counts"]["objects"]
    assert found["neighbours"] == {"Van": 6}
    assert found["not_evaluated"] == {"Tram": 6}
    assert found["DontCare"] == 1
    assert found["total"] == 18
    _, out, _ = curate("evaluate", "--labels", made.labels, "--results", made.results)
    assert (
        "objects of other categories: 6 Van (neighbour), 6 Tram (not evaluated), 1 DontCare" in out
    )
    own = evaluate(curate, made.labels, made.results, "--categories", "Truck")
    [warning] = [note for note in own["notes"] if note.startswith("There are no objects")]
    assert warning.startswith("There are no objects of Truck, but 6 Car, 6 Tram, 6 Van; evaluate")
    assert "--categories" in warning


def test_names_in_other_letters_are_said(curate: Curate, made: LidarOnly) -> None:
    """Else all cars would be missed, and AP 0, without a word."""
    for path in made.results.iterdir():
        path.write_text(path.read_text().replace("Car", "car"))
    categories = ("--categories", "Car,Bus")
    notes = evaluate(curate, made.labels, made.results, *categories)["notes"]
    assert "The results have 6 car, which is not Car: they do not count; write the names alike" in (
        notes
    )
    made.rewrite_labels("Pedestrian", "bus")
    notes = evaluate(curate, made.labels, made.results, *categories)["notes"]
    assert any(note.startswith("The objects have 6 bus, which is not Bus") for note in notes)


def test_any_category_can_be_evaluated(curate: Curate, made: LidarOnly) -> None:
    """With its own IoU threshold; the default is printed."""
    for folder in (made.labels, made.results):
        for path in folder.iterdir():
            path.write_text(path.read_text().replace("Cyclist", "Bus"))
    names = ("--categories", "Car,Bus")
    found = evaluate(curate, made.labels, made.results, *names)
    assert found["thresholds"] == {"Car": 0.7, "Bus": 0.5}
    assert found["AP_R40"]["Bus"]["3d"] == FULL
    code, out, _ = curate(
        *("evaluate", "--labels", made.labels, "--results", made.results, *names),
        *("--min-overlap", "Bus=0.65"),
    )
    assert code == 0
    assert "IoU above: Car 0.7, Bus 0.65" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--min-overlap", "Buss=0.7"), "did you mean 'Bus'?"),
        (("--min-overlap", "0.7"), "--min-overlap 0.7: write CATEGORY=IOU"),
        (("--min-overlap", "Bus=high"), "--min-overlap Bus=high: write CATEGORY=IOU"),
        (("--min-overlap", "Bus=1.5"), "must be above 0 and below 1"),
        (("--difficulty", "hard"), "use kitti, points or distance"),
        (("--distance-limits", "near"), "--distance-limits near: write numbers"),
        (("--difficulty", "points", "--minimum-points", "1,6"), "the largest first"),
        (("--image-size", "1242"), "--image-size 1242: write WIDTHxHEIGHT"),
        (("--categories", ","), "--categories ,: write names"),
    ],
)
def test_wrong_options_give_a_one_line_error(
    curate: Curate, made: LidarOnly, arguments: tuple[str, ...], message: str
) -> None:
    """With the option and what it accepts."""
    names = () if "--categories" in arguments else ("--categories", "Car,Bus")
    code, out, err = curate(
        "evaluate", "--labels", made.labels, "--results", made.results, *names, *arguments
    )
    assert (code, out) == (ConfigError.exit_code, "")
    assert message in err
    assert err.count("\n") == 1


def test_folders_of_sensors_are_checked(curate: Curate, made: LidarOnly, tmp_path: Path) -> None:
    """A folder that does not exist, a frame without a file, an option without folders."""
    folders = ("evaluate", "--labels", made.labels, "--results", made.results)
    code, _, err = curate(*folders, "--calib", tmp_path / "nowhere")
    assert (code, err) == (
        DataError.exit_code,
        f"error: {tmp_path / 'nowhere'}: no such folder; use a folder with one file per frame\n",
    )
    path = made.root / "training" / "calib" / "000003.txt"
    path.unlink()
    code, _, err = curate(*folders, "--calib", path.parent)
    assert code == DataError.exit_code
    assert f"{path}: no such file; the evaluation of frame 000003 needs it" in err
    partly = evaluate(curate, made.labels, made.results)
    assert partly["objects"]["Car"][2] == 5
    ignored = partly["counts"]["objects"]["categories"]["Car"]["ignored"]
    assert ignored == {"no 2D box": [1, 1, 1], "too small": [2, 0, 0]}
    code, _, err = curate("evaluate", "--calib", path.parent, "-w", tmp_path)
    assert (code, err) == (
        ConfigError.exit_code,
        "error: evaluate: --calib goes with --labels and --results\n",
    )


def test_levels_by_points_count_the_points_in_each_object(
    curate: Curate, made: LidarOnly, tmp_path: Path
) -> None:
    """8 in a car, 3 in a pedestrian, none in a cyclist; nothing of the image is needed."""
    found = evaluate(curate, made.labels, made.results, "--difficulty", "points")
    assert found["difficulties"] == ["level 1", "level 2"]
    assert found["limits"]["level 1"] == "at least 6 LiDAR points in the box"
    assert found["objects"] == {"Car": [6, 6], "Pedestrian": [0, 6], "Cyclist": [0, 0]}
    counts = found["counts"]["objects"]["categories"]
    assert counts["Pedestrian"]["ignored"] == {"few points": [6, 0]}
    assert counts["Cyclist"]["ignored"] == {"no points": [6, 6]}
    assert found["AP_R40"]["Car"] == {
        "image": None,
        "aos": None,
        "bev": [100.0] * 2,
        "3d": [100.0] * 2,
    }
    assert found["AP_R11"]["Pedestrian"]["bev"] == [None, 100.0]
    more = ("--difficulty", "points", "--minimum-points", "9,4,2")
    assert evaluate(curate, made.labels, made.results, *more)["objects"] == {
        "Car": [0, 6, 6],
        "Pedestrian": [0, 0, 6],
        "Cyclist": [0, 0, 0],
    }
    labels = made.alone(tmp_path / "alone")
    code, _, err = curate(
        "evaluate", "--labels", labels, "--results", made.results, "--difficulty", "points"
    )
    assert code == ConfigError.exit_code
    assert "has no folder calib beside it; specify --calib and --velodyne" in err


def test_a_workspace_has_the_levels_of_its_settings(curate: Curate, work: Path) -> None:
    """evaluation.difficulty, or the option for one command; the outcomes cover all distances."""
    path = work / "curate.toml"
    path.write_text(path.read_text().replace('difficulty = "kitti"', 'difficulty = "distance"'))
    code, out, _ = curate("evaluate", "--round", "1", "--json", "--store", "-w", work)
    found = json.loads(out)
    assert code == 0
    assert found["difficulties"] == ["0-30 m", "30-50 m", "50+ m"]
    assert found["objects"]["Car"] == [2, 2, 0]
    assert found["AP_R40"]["Car"]["3d"] == [100.0, 100.0, None]
    sql = "SELECT difficulty, count(*) AS n FROM evaluation_object WHERE side = 'object' GROUP BY 1"
    assert json.loads(curate("query", sql, "--json", "-w", work)[1]) == [
        {"difficulty": "0+ m", "n": 12}
    ]
    nulls = "SELECT count(*) AS n FROM evaluation_ap WHERE ap_r40 IS NULL AND figure = '3d'"
    expected = sum(value is None for name in NAMES for value in found["AP_R40"][name]["3d"])
    assert json.loads(curate("query", nulls, "--json", "-w", work)[1]) == [{"n": expected}]
    by_points = ("--difficulty", "points", "--minimum-points", "4")
    _, out, _ = curate("evaluate", "--round", "1", "--json", "-w", work, *by_points)
    assert json.loads(out)["objects"] == {"Car": [4], "Pedestrian": [0], "Cyclist": [0]}


def test_a_workspace_evaluates_its_categories(
    curate: Curate, made: LidarOnly, work: Path, tmp_path: Path
) -> None:
    """With evaluation.overlaps in evaluate and audit; an evaluated Van is not ignored."""
    for folder in (made.labels, made.results):
        for path in folder.iterdir():
            path.write_text(path.read_text().replace("Cyclist", "Van"))
    vans = tmp_path / "vans"
    init(
        *(curate, work.parent, made, vans, "--set", 'dataset.categories=["Car", "Van"]'),
        *("--set", "evaluation.overlaps={Van = 0.6}"),
    )
    _, out, _ = curate("evaluate", "--round", "1", "--json", "-w", vans)
    found = json.loads(out)
    assert found["thresholds"] == {"Car": 0.7, "Van": 0.6}
    assert found["AP_R40"]["Van"]["3d"] == FULL
    assert found["counts"]["objects"]["neighbours"] == {}
    assert found["counts"]["objects"]["not_evaluated"] == {"Pedestrian": 4}
    _, out, _ = curate("audit", "--json", "-w", vans, "--replicates", "20")
    audited = json.loads(out)
    assert audited["thresholds"] == {"Car": 0.7, "Van": 0.6}
    assert audited["counts"]["objects"]["categories"]["Van"]["total"] == 4
    assert audited["counts"]["labels"]["categories"]["Van"]["ignored"] == {}


def test_overlaps_of_unknown_categories_are_rejected(curate: Curate, work: Path) -> None:
    """At the start of every command, with the nearest name."""
    path = work / "curate.toml"
    path.write_text(path.read_text().replace("overlaps = {}", "overlaps = {Cra = 0.7}"))
    for command in ("status", "evaluate", "audit"):
        code, _, err = curate(command, "-w", work)
        assert code == ConfigError.exit_code
        assert "evaluation.overlaps: 'Cra' is not one of the evaluated categories" in err
        assert "did you mean 'Car'?" in err
        assert err.count("\n") == 1


class Blind(KittiDataset):
    """A data set in which no frame has an image."""

    def read(self, frame_id: str, *, points: bool = True, image: bool = False) -> Frame:
        """Read a frame without its image."""
        return replace(super().read(frame_id, points=points, image=image), image_size=None)


def test_frames_without_an_image_are_evaluated_by_distance(
    curate: Curate, made: LidarOnly, work: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a message; the audit ignores no DontCare region, which are in the image."""
    monkeypatch.setattr(Workspace, "dataset", property(lambda _: Blind(made.root)))
    code, out, _ = curate("evaluate", "--round", "1", "--json", "-w", work)
    assert code == 0
    found = json.loads(out)
    assert found["difficulty"] == "distance"
    assert found["AP_R40"]["Pedestrian"]["bev"] == [100.0, None, None]
    assert found["notes"][0].startswith("4 of 4 frames have no image")
    assert curate("audit", "-w", work, "--replicates", "20")[0] == 0


def test_a_lidar_only_evaluation_is_in_the_lidar_frame(
    curate: Curate, made: LidarOnly, work: Path
) -> None:
    """Distances are from the LiDAR, wherever the camera is."""
    shifted = toy_calibration()
    matrix = shifted.lidar_to_camera.copy()
    matrix[2, 3] = -40.0  # the camera is 40 m ahead
    for path in (made.root / "training" / "calib").iterdir():
        write_calibration(path, replace(shifted, lidar_to_camera=matrix))
    options = ("--difficulty", "distance", "--distance-limits", "10,14")
    _, out, _ = curate("evaluate", "--round", "1", "--json", "-w", work, *options)
    assert json.loads(out)["objects"] == {
        "Car": [0, 0, 4],
        "Pedestrian": [4, 0, 0],
        "Cyclist": [0, 0, 4],
    }


@pytest.mark.parametrize("options", [(), ("--difficulty", "distance"), ("--difficulty", "points")])
def test_the_tables_fit_into_80_columns(
    curate: Curate, made: LidarOnly, work: Path, monkeypatch: pytest.MonkeyPatch,
    options: tuple[str, ...],
) -> None:  # fmt: skip
    """As tables, not as blocks of rows; of folders, a workspace, and an audit."""
    folders = ("evaluate", "--labels", made.labels, "--results", made.results, *options)
    with terminal(monkeypatch, 80) as screen:
        curate(*folders)
        curate("evaluate", "--round", "1", "-w", work, *options)
    assert max(map(len, screen.lines)) <= 80
    assert sum(line.startswith("category ") for line in screen.lines) == 4
    assert not any(line.startswith("row 1") for line in screen.lines)
    if not options:
        with terminal(monkeypatch, 80) as screen:
            curate("audit", "-w", work, "--replicates", "20")
        assert max(map(len, screen.lines)) <= 80
        assert any(line.split() == ["Car", "objects", "4", "4"] for line in screen.lines)


def test_every_object_is_counted_once(curate: Curate, work: Path) -> None:
    """Counted and ignored by level add up to all objects of a workspace."""
    for options in ((), ("--difficulty", "points"), ("--difficulty", "distance")):
        _, out, _ = curate("evaluate", "--round", "1", "--json", "-w", work, *options)
        for side in json.loads(out)["counts"].values():
            for each in side["categories"].values():
                sums = np.array(each["counted"]) + sum(map(np.array, each["ignored"].values()))
                assert (sums == each["total"]).all()
