"""Category names of label files, detector, segmenter and settings, compared before any work."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import text
from support.dataset_layouts import DRIVE, write_toy_folder, write_toy_raw
from support.nuscenes_scenes import write_nuscenes
from support.pipelines_cli import Curate
from support.toys import write_toy_kitti

from curate.datasets.kitti.dataset import KittiDataset
from curate.errors import ConfigError, DataError
from curate.segmenters.base import SemanticMap
from pipelines.assembly import check_prior, check_segmenter_names, open_segmenter
from pipelines.workspace.config import Config, make_config
from pipelines.workspace.workspace import Workspace

HEADER = "frame,view,flip_y,rotation_rad,scale,category,score,x,y,z,length,width,height,yaw"
LOWER = {"car": "Car", "cyclist": "Cyclist", "pedestrian": "Pedestrian"}
SUGGESTED = 'dataset.rename={car="Car", cyclist="Cyclist", pedestrian="Pedestrian"}'


def rewrite_labels(folder: Path, change: Callable[[str], str]) -> None:
    """Change the text of every label file of a folder."""
    for path in folder.glob("*.txt"):
        path.write_text(change(path.read_text()))


def lower(text: str) -> str:
    """Return KITTI lines with names in lower case."""
    return re.sub(r"^\S+", lambda name: name[0].lower(), text, flags=re.MULTILINE)


def names_of(work: Path) -> dict[str, int]:
    """Return the stored objects by category."""
    query = "SELECT category, count(*) FROM ground_truth GROUP BY category ORDER BY category"
    with Workspace.open(work).database.reading() as connection:
        return dict(connection.execute(text(query)).all())


def toy_kitti_layout(root: Path) -> tuple[Path, Path]:
    write_toy_kitti(root, 4)
    return root, root / "training" / "label_2"


def toy_raw_layout(root: Path) -> tuple[Path, Path]:
    write_toy_raw(root)
    return root / "2011_09_26", root / "2011_09_26" / DRIVE / "label_2"


def toy_folder_layout(root: Path) -> tuple[Path, Path]:
    write_toy_folder(root)
    return root, root / "boxes"


LAYOUTS = {
    "kitti": toy_kitti_layout,
    "kitti-raw": toy_raw_layout,
    "folder": toy_folder_layout,
    "curate.datasets.kitti.dataset:KittiDataset": toy_kitti_layout,
}


@pytest.mark.parametrize("kind", LAYOUTS)
def test_names_of_no_category_end_init(curate: Curate, tmp_path: Path, kind: str) -> None:
    """Every kind of data set: both sides are named, and the printed setting works."""
    root, labels = LAYOUTS[kind](tmp_path / "data")
    rewrite_labels(labels, lower)
    begin = ("init", tmp_path / "w", "--dataset", kind, "--root", root, "--labeled", "0.5",
             "--split-by", "frame", "--val", "0")  # fmt: skip
    code, out, err = curate(*begin)
    assert (code, out) == (ConfigError.exit_code, "")
    assert "error: the label files have car 2, cyclist 2, pedestrian 2, but dataset." in err
    assert "dataset.categories are Car, Pedestrian, Cyclist: no name is the same" in err
    assert f"--set '{SUGGESTED}'" in err
    assert not (tmp_path / "w").exists()
    code, out, err = curate(*begin, "--set", SUGGESTED)
    assert code == 0, err
    assert "objects in the label files: Car 2, Cyclist 2, Pedestrian 2\n" in out
    assert names_of(tmp_path / "w") == {"Car": 2, "Cyclist": 2, "Pedestrian": 2}


def test_the_names_of_nuscenes_follow_the_setting(curate: Curate, tmp_path: Path) -> None:
    """Unset, three classes have KITTI's names; set, only the mapping counts."""
    write_nuscenes(tmp_path / "data", ("scene-0001", "scene-0002"), 2, "v1.0-mini")
    begin = ("--dataset", "nuscenes", "--root", tmp_path / "data", "--labeled", "0.5")
    own = ("--set", 'dataset.categories=["PKW", "bicycle"]')
    assert curate("init", tmp_path / "a", *begin)[0] == 0
    assert set(names_of(tmp_path / "a")) == {"Car", "Pedestrian", "Cyclist"}
    code, _, err = curate("init", tmp_path / "b", *begin, *own)
    assert code == ConfigError.exit_code
    assert "the label files have Car 2, Cyclist 2, Pedestrian 2, but" in err
    mapping = 'rename={car="PKW"}'
    for work, option in (
        ("c", ("--set", f"dataset.{mapping}")),
        ("d", ("--dataset-option", mapping)),
    ):
        code, _, err = curate("init", tmp_path / work, *begin, *own, *option)
        assert code == 0, err
        assert set(names_of(tmp_path / work)) == {"PKW", "bicycle", "pedestrian"}


def test_declared_categories_are_the_vocabulary(curate: Curate, tmp_path: Path) -> None:
    """Cars and buses in KITTI's layout, with DontCare regions."""
    root, labels = toy_kitti_layout(tmp_path / "data")
    rewrite_labels(labels, lambda text: text.replace("Pedestrian", "Bus").replace("Cyclist", "Bus"))
    begin = ("init", tmp_path / "w", "--root", root, "--labeled", "0.5", "--val", "0")
    code, _, err = curate(*begin)
    assert code == DataError.exit_code
    assert re.search(r"label_2/00000\d\.txt:2: unknown category 'Bus'; known are Car, ", err)
    assert """--set 'dataset.rename={Bus="Bus"}'""" in err
    assert not (tmp_path / "w").exists()
    code, out, err = curate(*begin, "--set", 'dataset.categories=["Car", "Bus"]')
    assert (code, err) == (0, "")
    assert "objects in the label files: Bus 4, Car 2\n" in out
    left_out = ("--set", 'dataset.rename={Bus="Bus"}')
    code, out, _ = curate("init", tmp_path / "v", *begin[2:], *left_out)
    assert code == 0
    assert "objects in the label files: Car 2; not in dataset.categories: Bus 4\n" in out


def test_a_typing_error_in_kittis_layout_is_rejected(curate: Curate, tmp_path: Path) -> None:
    """With file, line and what was meant."""
    root, labels = toy_kitti_layout(tmp_path / "data")
    rewrite_labels(labels, lambda text: text.replace("Cyclist", "Cyclsit"))
    code, _, err = curate("init", tmp_path / "w", "--root", root, "--labeled", "0.5", "--val", "0")
    assert code == DataError.exit_code
    assert ".txt:3: unknown category 'Cyclsit'; did you mean 'Cyclist'?" in err
    assert """--set 'dataset.rename={Cyclsit="Cyclist"}'""" in err


def test_the_mapping_shown_has_every_unknown_name_and_the_names_that_are_mapped(
    curate: Curate, tmp_path: Path
) -> None:
    """Used as it is shown, it ends the errors; it does not undo the mapping so far."""
    root, labels = toy_kitti_layout(tmp_path / "data")
    rewrite_labels(labels, str.lower)
    begin = ("init", tmp_path / "w", "--root", root, "--labeled", "0.5", "--val", "0")
    cars = ("--set", 'dataset.categories=["Car"]', "--set", 'dataset.rename={car="Car"}')
    code, _, err = curate(*begin, *cars)
    assert code == DataError.exit_code
    shown = re.search(r"--set '(dataset.rename=.*?)'$", err.strip())
    assert shown
    assert 'car="Car"' in shown[1]
    code, _, err = curate(*begin, *cars[:2], "--set", shown[1])
    assert code == 0, err


def test_labels_of_unlabeled_frames_are_not_read(curate: Curate, tmp_path: Path) -> None:
    """Not even their names: a wrong one there is not found."""
    root, labels = toy_kitti_layout(tmp_path / "data")
    (tmp_path / "list.txt").write_text("000000\n")
    for name in ("000001", "000002", "000003"):
        (labels / f"{name}.txt").write_text("Unicorn and nothing else")
    begin = ("init", tmp_path / "w", "--root", root, "--labeled", tmp_path / "list.txt")
    code, out, err = curate(*begin, "--val", "0")
    assert (code, err) == (0, "")
    assert "Car 1, Cyclist 1, Pedestrian 1" in out


def test_differences_are_said_by_every_command(
    curate: Curate, workspace: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    """A category that never occurs is a warning at the start of each."""
    set_in(workspace, "categories", '["Car", "Pedestrian", "Cyclist", "Bus"]')
    set_in(workspace, "priors", '["points"]')
    commands = ("predict", "repredict", "score", "solve", "export", "run", "evaluate", "audit")
    for command in commands:
        caplog.clear()
        code, _, err = curate(command, "-w", workspace.root)
        assert code == 0, (command, err)
        assert "the label files have no Bus, only Car, Cyclist, Pedestrian" in caplog.text, command
    code, out, _ = curate("doctor", "-w", workspace.root)
    assert code == 0
    assert re.search(r"^suspect +names +the label files have no Bus", out, re.MULTILINE)
    code, out, _ = curate("check", "-w", workspace.root)
    assert code == 0
    assert re.search(r"^warn +category names agree +the label files have no Bus", out, re.MULTILINE)


def set_in(workspace: Workspace, key: str, value: str) -> None:
    """Set the first setting of a name in `curate.toml`."""
    path = workspace.root / "curate.toml"
    text, count = re.subn(
        rf"^(# )?{key} = .*$", f"{key} = {value}", path.read_text(), count=1, flags=re.MULTILINE
    )
    assert count
    path.write_text(text)


WORKING = ("predict", "repredict", "score", "solve", "export", "train-round", "run", "evaluate",
           "audit", "check", "pretrain")  # fmt: skip


@pytest.mark.parametrize("command", WORKING)
def test_wrong_names_stop_every_command(curate: Curate, workspace: Workspace, command: str) -> None:
    """Before any frame is worked on; with both sides and the mapping."""
    set_in(workspace, "categories", '["car", "pedestrian"]')
    code, out, err = curate(command, "-w", workspace.root)
    assert code == ConfigError.exit_code
    assert "the label files have Car 6, Cyclist 6, Pedestrian 6, but dataset.categ" in err
    assert """rename = {Car="car", Pedestrian="pedestrian"} in [dataset] of curate.toml""" in (
        err.replace(', Cyclist="cyclist"', "")
    )
    assert "rows" not in out
    with workspace.database.reading() as connection:
        assert connection.execute(text("SELECT count(*) FROM task")).scalar_one() == 0


def test_a_mapping_set_after_init_renames_the_stored_truth(
    curate: Curate, workspace: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    """Once, with a message; doctor and check change nothing."""
    set_in(workspace, "categories", '["Auto", "Pedestrian", "Cyclist"]')
    set_in(workspace, "rename", '{Car = "Auto"}')
    set_in(workspace, "priors", '["points"]')
    curate("check", "-w", workspace.root)
    assert names_of(workspace.root) == {"Car": 6, "Cyclist": 6, "Pedestrian": 6}
    code, _, err = curate("predict", "-w", workspace.root)
    assert code == 0, err
    assert caplog.text.count("6 objects Car are Auto now (dataset.rename)") == 1
    assert names_of(workspace.root) == {"Auto": 6, "Cyclist": 6, "Pedestrian": 6}
    caplog.clear()
    curate("predict", "-w", workspace.root)
    assert "are Auto now" not in caplog.text


def write_record(path: Path, root: Path, change: Callable[[str], str]) -> Path:
    """Write a CSV record of the toy objects, a centimetre off, with one augmented copy."""
    dataset, rows = KittiDataset(root), [HEADER]
    for name in dataset.frame_ids():
        truth = dataset.annotations(name)
        for category, box in zip(truth.categories.tolist(), truth.boxes, strict=True):
            numbers = ",".join(f"{number:.6f}" for number in np.add(box, [0.01, *[0] * 6]))
            if change(category):
                rows += [f"{name},{view},0,0,{1 + view / 50},{change(category)},0.9,{numbers}"
                         for view in (0, 1)]  # fmt: skip
    path.write_text("\n".join(rows) + "\n")
    return path


def recorded(curate: Curate, work: Path, root: Path, record: Path) -> tuple[int, str, str]:
    """Create a workspace with recorded results and the point prior alone."""
    return curate(
        "init", work, "--root", root, "--labeled", "0.25",
        "--detector", "recorded", "--detector-path", record,
    )  # fmt: skip


def exports(work: Path) -> dict[str, bytes]:
    """Return the content of every exported file."""
    folder = work / "exports"
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("command", ["predict", "run", "evaluate", "audit"])
def test_results_without_a_known_name_leave_the_export_untouched(
    curate: Curate, tmp_path: Path, toy_kitti: Path, command: str
) -> None:
    """After a good run, results with 'vehicle' alone are rejected before any work."""
    work = tmp_path / "w"
    record = write_record(tmp_path / "a.csv", toy_kitti, str)
    assert recorded(curate, work, toy_kitti, record)[0] == 0
    assert curate("run", "-w", work)[0] == 0
    before = exports(work)
    write_record(record, toy_kitti, lambda _: "vehicle")
    code, out, err = curate(command, "-w", work)
    assert (code, out) == (ConfigError.exit_code, "")
    assert f"error: the results {record} have vehicle, but dataset.categories are Car, " in err
    assert 'rename = {vehicle="Car"} in [detector] of curate.toml' in err
    assert exports(work) == before
    code, out, _ = curate("doctor", "-w", work)
    assert code == 1
    assert re.search(r"^wrong +names +the results .* have vehicle", out, re.MULTILINE)
    assert curate("check", "-w", work)[0] == ConfigError.exit_code


def test_the_printed_mapping_of_a_detector_works(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """At init, and in curate.toml; also for a detector of another class."""
    work = tmp_path / "w"
    record = write_record(tmp_path / "a.csv", toy_kitti, str.lower)
    code, _, err = recorded(curate, work, toy_kitti, record)
    assert code == ConfigError.exit_code
    [setting] = re.findall(r"--set '(detector\.rename=\{.*?\})'", err)
    code, _, err = curate(
        "init", work, "--root", toy_kitti, "--labeled", "0.25", "--set", setting,
        "--detector", "recorded", "--detector-path", record,
    )  # fmt: skip
    assert code == 0, err
    code, out, err = curate("predict", "-w", work)
    assert code == 0, err
    assert "18 rows" in out


def test_a_detector_that_does_not_know_its_names_is_renamed(
    curate: Curate, workspace: Workspace
) -> None:
    """The mapping is applied to what any class returns."""
    path = workspace.root / "curate.toml"
    head, section, rest = path.read_text().partition("[detector]")
    unset = '# rename = {car = "Car"}'
    assert unset in rest
    path.write_text(head + section + rest.replace(unset, 'rename = {Car = "Pedestrian"}', 1))
    assert curate("predict", "-w", workspace.root)[0] == 0
    query = "SELECT category, count(*) AS n FROM prediction GROUP BY category ORDER BY category"
    _, out, _ = curate("query", query, "--json", "-w", workspace.root)
    assert json.loads(out) == [{"category": "Cyclist", "n": 6}, {"category": "Pedestrian", "n": 12}]


def test_an_older_place_of_the_mapping_is_accepted(tmp_path: Path) -> None:
    """`options.rename` of recorded detectors and of nuScenes moves to the setting."""
    document = {
        "dataset": {"root": tmp_path, "kind": "nuscenes", "options": {"rename": {}}},
        "detector": {"name": "recorded", "options": {"rename": {"car": "Car"}, "kind": "csv"}},
    }
    config = make_config(document, "test")
    assert (config.dataset.rename, config.dataset.options) == ({}, {})
    assert (config.detector.rename, config.detector.options) == ({"car": "Car"}, {"kind": "csv"})
    own = {"dataset": {"root": tmp_path}, "detector": {"name": "a:B", "options": {"rename": 1}}}
    assert make_config(own, "test").detector.options == {"rename": 1}
    with pytest.raises(ConfigError, match=r"detector: both rename and options\.rename are set"):
        document["detector"] |= {"rename": {"a": "b"}}
        make_config(document, "test")


@pytest.mark.parametrize("section", ["dataset", "detector", "segmenter"])
def test_a_mapping_in_steps_is_rejected(curate: Curate, tmp_path: Path, section: str) -> None:
    """For every side alike."""
    code, _, err = curate(
        "init", tmp_path / "w", "--root", tmp_path, "--set", f'{section}.rename={{a="b", b="c"}}'
    )
    assert code == ConfigError.exit_code
    assert f"{section}.rename: 'a' becomes 'b', which becomes 'c'" in err


class OwnSegmenter:
    """A segmenter from outside with a table of its own, which it knows."""

    needs_image = False
    needs_points = False

    def __init__(self, path: Path) -> None:
        self.classes = {"car": (1,), "Pedestrian": (2,), "Cyclist": (3,)}

    def segment(self, frame) -> SemanticMap:
        """Return an empty map."""
        width, height = frame.image_size
        return SemanticMap(np.zeros((height, width), np.uint8), self.classes)


def segmenter_config(root: Path, categories: tuple[str, ...], **section: object) -> Config:
    """Return a configuration with a segmenter."""
    document = {
        "dataset": {"root": root, "categories": categories},
        "segmenter": {"path": root, **section},
    }
    return make_config(document, "test")


KINDS = {
    "simulated": {},
    "degraded": {},
    **{name: {"classes": "voc"} for name in ("onnx", "onnx-instances", "saved", "instances")},
}


@pytest.mark.parametrize("name", KINDS)
def test_a_segmenter_without_a_class_for_a_category(tmp_path: Path, name: str) -> None:
    """Every kind: an error without opening it, with the settings that help."""
    check_segmenter_names(segmenter_config(tmp_path, ("Car",), name=name, **KINDS[name]))
    config = segmenter_config(tmp_path, ("Car", "Van"), name=name, **KINDS[name])
    with pytest.raises(ConfigError) as info:
        check_prior(config, "semantic")
    message = str(info.value)
    assert "has Car, Cyclist, Pedestrian, but none for Van of dataset.categories" in message
    assert re.search(
        r"set segmenter\.options\.classes = \{Car = \[\d\], Van = \[\.\.\.\]\}", message
    )
    assert "leave 'semantic' out of run.priors" in message


def test_the_table_of_a_segmenter_can_be_renamed(tmp_path: Path) -> None:
    """Built-in sets and tables of the user; the message has the mapping."""
    categories = ("car", "cyclist")
    config = segmenter_config(tmp_path, categories, name="saved", classes="voc")
    with pytest.raises(ConfigError, match=r'set segmenter\.rename = \{Car="car", Cyclist="cyc'):
        check_segmenter_names(config)
    rename = {"Car": "car", "Cyclist": "cyclist"}
    config = segmenter_config(tmp_path, categories, name="saved", classes="voc", rename=rename)
    check_segmenter_names(config)
    root, _ = toy_kitti_layout(tmp_path / "data")
    config = config.model_copy(update={"dataset": config.dataset.model_copy(update={"root": root})})
    opened = open_segmenter(config)
    assert (opened.needs_image, opened.needs_points) == (False, False)
    own = {"classes": {"Car": [1], "Van": [2]}}
    config = segmenter_config(tmp_path, ("Car",), name="saved", options=own, rename={"Van": "Car"})
    check_segmenter_names(config)


def test_the_table_of_a_segmenter_from_outside_is_compared(tmp_path: Path) -> None:
    """When it is opened, before a frame is read; its maps are renamed."""
    name = f"{__name__}:OwnSegmenter"
    config = segmenter_config(tmp_path, ("Car", "Cyclist"), name=name)
    with pytest.raises(
        ConfigError, match=r'none for Car .*: set segmenter\.rename = \{car="Car"\}'
    ):
        check_prior(config, "semantic")
    config = segmenter_config(tmp_path, ("Car", "Cyclist"), name=name, rename={"car": "Car"})
    root, _ = toy_kitti_layout(tmp_path / "data")
    found = open_segmenter(config).segment(KittiDataset(root).read("000000"))
    assert found.category_classes == {"Car": (1,), "Pedestrian": (2,), "Cyclist": (3,)}


def test_a_category_without_class_ends_init_and_score(
    curate: Curate, workspace: Workspace, tmp_path: Path, toy_kitti: Path
) -> None:
    """Before a frame is segmented, and not if no prior counts pixels."""
    own = ("--segmenter", "simulated", "--set", 'dataset.categories=["Car", "Van"]')
    code, _, err = curate("init", tmp_path / "v", "--root", toy_kitti, "--labeled", "0.25", *own)
    assert code == ConfigError.exit_code
    assert "segmenter 'simulated': its table of classes has Car, Cyclist, Pedestrian, but" in err
    plain = ("--set", 'run.priors=["points"]')
    arguments = ("init", tmp_path / "v", "--root", toy_kitti, "--labeled", "0.25", *own, *plain)
    assert curate(*arguments)[0] == 0


def test_categories_in_options_of_policies_are_compared(
    curate: Curate, tmp_path: Path, toy_kitti: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A threshold of a category that does not exist has no effect."""
    setting = "solve.options.threshold={per_category={car=0.5, Cyclist=0.4}}"
    code, _, _ = curate(
        "init", tmp_path / "w", "--root", toy_kitti, "--labeled", "0.25", "--set", setting
    )
    assert code == 0
    assert "solve.options.threshold.per_category: 'car' is not in dataset.cat" in caplog.text
    assert "did you mean 'Car'?" in caplog.text


def test_pretrain_without_objects_is_an_error(
    curate: Curate, tmp_path: Path, toy_kitti: Path
) -> None:
    """Both sides are named; nothing is trained."""
    rewrite_labels(toy_kitti / "training" / "label_2", lambda _: "")
    work = tmp_path / "w"
    assert curate("init", work, "--root", toy_kitti, "--labeled", "0.25")[0] == 0
    for command in ("pretrain", "run"):
        code, _, err = curate(command, "-w", work)
        assert code == ConfigError.exit_code
        assert "no object to learn from: the label files of the 2 labeled frames have no obj" in err
        assert "dataset.categories are Car, Pedestrian, Cyclist" in err
    assert not list((work / "checkpoints").iterdir())
