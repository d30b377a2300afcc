"""Workspaces without a camera, with several, and with labels that no camera shows."""

import csv
import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.dataset_layouts import write_toy_folder, write_toy_raw
from support.nuscenes_scenes import (
    IMAGE_SIZE,
    MOUNTED,
    SIDES,
    drawn_boxes,
    into_map,
    sample_token,
    vehicle_pose,
    write_nuscenes,
)
from support.pipelines_cli import Curate
from support.toys import toy_calibration, write_toy_kitti

from curate.datasets.nuscenes import NuScenesDataset
from pipelines.assembly import open_segmenter
from pipelines.serving.shown_frames import FramePages
from pipelines.workspace.workspace import Workspace

SCENES = ("scene-0001", "scene-0002", "scene-0003")
STEPS = 2
CAMERAS = ("CAM_FRONT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT", "CAM_FRONT_LEFT",
           "CAM_FRONT_RIGHT")  # fmt: skip


def kitti(root: Path) -> list[str]:
    """Write KITTI's layout without image_2; return the options of init."""
    write_toy_kitti(root, 10, 3)
    shutil.rmtree(root / "training" / "image_2")
    return ["--dataset", "kitti"]


def kitti_raw(root: Path) -> list[str]:
    """Write a raw drive without image_02."""
    write_toy_raw(root, 10)
    for folder in root.glob("*/*/image_02"):
        shutil.rmtree(folder)
    return ["--dataset", "kitti-raw", "--split-by", "frame", "--val", "0.3"]


def folder(root: Path) -> list[str]:
    """Write a folder with neither images nor image_size."""
    write_toy_folder(root, 10)
    shutil.rmtree(root / "camera")
    path = root / "dataset.toml"
    path.write_text(path.read_text().replace('images = "camera"\n', ""))
    return ["--dataset", "folder", "--val", "0.3"]


def lidar_only(root: Path) -> list[str]:
    """Write a folder whose images have a size, but no files."""
    options = folder(root)
    path = root / "dataset.toml"
    path.write_text("image_size = [120, 40]\n" + path.read_text())
    return options


BARE = {"kitti": kitti, "kitti-raw": kitti_raw, "folder": folder, "folder with size": lidar_only}


@pytest.mark.parametrize("layout", BARE)
def test_without_images_everything_works_that_needs_no_pixels(
    tmp_path: Path,
    weights_file: Path,
    curate: Curate,
    caplog: pytest.LogCaptureFixture,
    layout: str,
) -> None:
    """All commands, from init to audit; init says once what is left out."""
    options = BARE[layout](tmp_path / "data")
    work = tmp_path / "work"
    code, out, err = curate(
        "init", work, "--root", tmp_path / "data", "--labeled", "0.3", *options,
        "--detector", "support.toys:ToyDetector", "--detector-path", weights_file,
        "--segmenter", "support.toys:ToySegmenter", "--segmenter-path", weights_file,
    )  # fmt: skip
    assert code == 0, err
    said = caplog.text
    caplog.clear()
    assert 'run.priors = ["points"]' in said
    assert said.count("pictures show the bird's eye view alone") == 1
    has_size = layout == "folder with size"
    assert ("the detector gets the points all around" in said) is not has_size
    assert 'priors = ["points"]' in (work / "curate.toml").read_text()
    here = ("--workspace", work)
    for command in ("doctor", "check", "predict", "repredict", "score", "solve", "report"):
        code, out, err = curate(command, *here)
        assert code == 0, f"{command}: {out}{err}"
    for kind in ("sqlite", "kitti", "csv", "st3d", "mmdet3d", "parquet"):
        code, out, err = curate("export", "--format", kind, *here)
        assert code == 0, f"{kind}: {err}"
    code, _, err = curate("export", "--format", "coco", *here)
    assert code == 2
    assert "COCO's annotations need images, and the data set has none" in err
    code, _, err = curate("export", "--format", "openpcdet", *here)
    assert code == (0 if has_size else 2)
    assert has_size or "need the size of the camera's image" in err
    workspace = Workspace.open(work)
    name = next(iter(workspace.frames("unlabeled")))
    picture = tmp_path / "view.png"
    assert curate("view", name, "--output", picture, *here)[0] == 0
    height, width = cv2.imread(str(picture)).shape[:2]
    assert (width, height) == (1008, 972)  # a bird's eye view of the default region
    for editor in ("kitti", "labelcloud", "cvat"):
        review = tmp_path / editor
        code, _, err = curate("review", "export", review, "--format", editor, *here)
        assert code == 0, err
        assert len(list((review / "pictures").iterdir())) > 0
        code, _, err = curate("review", "import", review, "--dry-run", *here)
        assert code == 0, err
    pages = FramePages(workspace)
    assert pages.picture(pages.find(name, None, None, None)).startswith(b"\xff\xd8")
    for command in (("evaluate",), ("audit", "--split", "val"), ("explain", name, "0")):
        code, out, err = curate(*command, *here)
        assert code == 0, f"{command}: {err}"
    assert "bird's eye view" not in caplog.text
    rows = workspace.database.rows(_select("frame", "image_path"))
    assert {row[0] for row in rows} == {None}


def _select(table: str, *columns: str) -> object:
    """Return a query of some columns."""
    from sqlalchemy import select

    from db import bulk

    return select(*(bulk.table(table).c[name] for name in columns))


def test_an_explicit_semantic_prior_without_images_is_an_error(
    tmp_path: Path, weights_file: Path, curate: Curate
) -> None:
    """Nothing is written; the message says what to change."""
    kitti(tmp_path / "data")
    code, _, err = curate(
        "init", tmp_path / "work", "--root", tmp_path / "data", "--labeled", "0.3",
        "--detector", "support.toys:ToyDetector", "--detector-path", weights_file,
        "--segmenter", "support.toys:ToySegmenter", "--segmenter-path", weights_file,
        "--set", 'run.priors=["points", "semantic"]',
    )  # fmt: skip
    assert code != 0
    assert "the data set has no camera" in err
    assert "leave 'semantic' out" in err
    assert not (tmp_path / "work").exists()


def test_an_image_size_keeps_the_crop_to_the_cameras_view(
    tmp_path: Path, weights_file: Path, curate: Curate, caplog: pytest.LogCaptureFixture
) -> None:
    """As an option of KITTI's layout; with images it is rejected."""
    arguments = (
        "--labeled", "0.3", "--detector", "support.toys:ToyDetector",
        "--detector-path", weights_file, "--dataset-option", "image_size=[120, 40]",
    )  # fmt: skip
    write_toy_kitti(tmp_path / "full", 10, 3)
    code, _, err = curate("init", tmp_path / "a", "--root", tmp_path / "full", *arguments)
    assert code != 0
    assert "image_size is for data sets without images" in err
    kitti(tmp_path / "bare")
    code, _, err = curate("init", tmp_path / "b", "--root", tmp_path / "bare", *arguments)
    assert code == 0, err
    assert "points all around" not in caplog.text
    code, out, _ = curate("doctor", "--workspace", tmp_path / "b")
    assert code == 0
    assert "of the points appear in the image" in out


def test_missing_images_are_counted_and_fail(
    tmp_path: Path, weights_file: Path, curate: Curate, caplog: pytest.LogCaptureFixture
) -> None:
    """They are not taken for a data set without images."""
    write_toy_kitti(tmp_path / "data", 10, 3)
    for name in ("000001", "000004"):
        (tmp_path / "data" / "training" / "image_2" / f"{name}.png").unlink()
    (tmp_path / "labeled.txt").write_text("000000\n000002\n")
    code, _, _ = curate(
        "init", tmp_path / "work", "--root", tmp_path / "data",
        "--labeled", tmp_path / "labeled.txt",
        "--detector", "support.toys:ToyDetector", "--detector-path", weights_file,
        "--segmenter", "support.toys:ToySegmenter", "--segmenter-path", weights_file,
    )  # fmt: skip
    assert code == 0
    assert "2 images are missing, such as" in caplog.text
    assert "000001.png" in caplog.text
    code, out, err = curate("predict", "--workspace", tmp_path / "work")
    assert code != 0
    assert "2 failed" in out
    assert "no such image file" in err


@pytest.fixture
def nuscenes(tmp_path: Path) -> Path:
    """Return three scenes with the LiDAR and six cameras."""
    root = tmp_path / "nuscenes"
    write_nuscenes(root, SCENES, STEPS, "v1.0-trainval", mounted=(*MOUNTED, *SIDES))
    return root


def write_results(path: Path) -> Path:
    """Write detections of every drawn object in nuScenes' format."""
    results = {}
    for number, scene in enumerate(SCENES):
        for step in range(STEPS):
            boxes = np.add(drawn_boxes(number, step), [0.02, 0, 0, 0, 0, 0, 0])
            placed = into_map(boxes, vehicle_pose(number, step))
            names = (("car", 0.8), ("pedestrian", 0.6), ("bicycle", 0.5), ("car", 0.7))
            results[sample_token(scene, step)] = [
                box | {"detection_name": name, "detection_score": score, "velocity": [0, 0]}
                for box, (name, score) in zip(placed, names, strict=True)
            ]
    path.write_text(json.dumps({"meta": {}, "results": results}))
    return path


def write_maps(folder: Path, cameras: tuple[str, ...], car: int = 13) -> Path:
    """Write a map per frame and camera that is all cars (Cityscapes), or of one camera."""
    for camera in cameras:
        (folder / camera).mkdir(parents=True, exist_ok=True)
        for scene in SCENES:
            for step in range(STEPS):
                pixels = np.full((IMAGE_SIZE[1], IMAGE_SIZE[0]), car, np.uint8)
                cv2.imwrite(str(folder / camera / f"{sample_token(scene, step)}.png"), pixels)
    return folder


def scored(
    curate: Curate, work: Path, root: Path, results: Path, maps: Path, *options: str
) -> list[dict[str, str]]:
    """Create a workspace with saved maps, weigh its labels, and return the rows of the query."""
    code, _, err = curate(
        "init", work, "--dataset", "nuscenes", "--root", root, "--labeled", "0.5", *options,
        "--detector", "recorded", "--detector-path", results, "--set", "solve.self_paced=false",
        "--segmenter", "saved", "--segmenter-path", maps, "--segmenter-classes", "cityscapes",
        "--set", 'dataset.categories=["Car"]', "--set", "detector.camera_view=false",
    )  # fmt: skip
    assert code == 0, err
    for command in ("predict", "repredict", "score", "solve"):
        code, out, err = curate(command, "--workspace", work)
        assert code == 0, f"{command}: {out}{err}"
    code, out, err = curate(
        "query", "SELECT * FROM weighted_labels ORDER BY frame, k", "--csv", "--workspace", work
    )
    assert code == 0, err
    return list(csv.DictReader(io.StringIO(out)))


def test_each_camera_gets_the_stored_map_of_its_own_image(
    nuscenes: Path, tmp_path: Path, curate: Curate
) -> None:
    """Made ahead by segment for all six, and read for each."""
    dataset = NuScenesDataset(nuscenes, cameras="all")
    generator = np.random.default_rng(0)
    for name in dataset.frame_ids():
        for path in dataset.files(name).images:
            bright = generator.integers(0, 2, (IMAGE_SIZE[1], IMAGE_SIZE[0], 1)) * np.full(3, 255)
            cv2.imwrite(str(path), bright.astype(np.uint8))
    work, model = tmp_path / "work", tmp_path / "model"
    model.touch()
    code, _, err = curate(
        "init", work, "--dataset", "nuscenes", "--root", nuscenes, "--labeled", "0.5",
        "--dataset-option", "cameras=all", "--detector", "recorded",
        "--detector-path", write_results(tmp_path / "results.json"),
        "--segmenter", "support.toys:ToyImageSegmenter", "--segmenter-path", model,
    )  # fmt: skip
    assert code == 0, err
    code, _, err = curate("segment", "--workspace", work)
    assert code == 0, err
    workspace = Workspace.open(work)
    names = list(workspace.frames("unlabeled"))
    segmented = (tmp_path / "segmented.txt").read_text().split()  # init has segmented one frame
    assert sorted(each for each in segmented if each in names) == sorted(names * len(CAMERAS))
    segmenter = open_segmenter(workspace.config)
    for name in names:
        for view in dataset.read(name, image=True).views():
            found = segmenter.segment(replace(view, image=None)).class_ids
            np.testing.assert_array_equal(found == 1, view.image[..., 0] >= 128)
    assert (tmp_path / "segmented.txt").read_text().split() == segmented


def test_six_cameras_give_labels_of_every_direction_image_evidence(
    nuscenes: Path, tmp_path: Path, curate: Curate
) -> None:
    """The camera is stored, explained, exported and drawn; the crop is the union."""
    results, work = write_results(tmp_path / "results.json"), tmp_path / "work"
    maps = write_maps(tmp_path / "maps", CAMERAS)
    rows = scored(curate, work, nuscenes, results, maps, "--dataset-option", "cameras=all")
    assert list(rows[0])[-1] == "camera"
    ahead = {row["camera"] for row in rows if float(row["x"]) > 0}
    behind = {row["camera"] for row in rows if float(row["x"]) < 0}
    assert ahead <= {"CAM_FRONT", "CAM_FRONT_RIGHT"}
    assert behind == {"CAM_BACK"}
    assert all(row["mask_pixels"] == row["box_pixels"] != "0" for row in rows)
    here = ("--workspace", work)
    back = next(row for row in rows if row["camera"] == "CAM_BACK")
    code, out, _ = curate("explain", back["frame"], back["k"], *here)
    assert code == 0
    assert "camera CAM_BACK: Eq. 9" in out
    picture = tmp_path / "view.png"
    assert curate("view", back["frame"], "--output", picture, *here)[0] == 0
    one = tmp_path / "front.png"
    front = tmp_path / "only-front"
    scored(curate, front, nuscenes, results, write_maps(tmp_path / "one", ("",)))
    assert curate("view", back["frame"], "--output", one, "--workspace", front)[0] == 0
    assert len(cv2.imread(str(picture))) > len(cv2.imread(str(one)))
    for command in ("report", "doctor"):
        code, out, err = curate(command, *here)
        assert code == 0, f"{command}: {out}{err}"
    code, _, err = curate("export", "--format", "coco", *here)
    assert code == 0, err
    coco = json.loads(next((work / "exports").glob("*coco*")).read_text())
    images = {image["id"]: image for image in coco["images"]}
    assert len(images) == 6 * len({image["frame"] for image in images.values()})
    assert all((nuscenes / image["file_name"]).exists() for image in images.values())
    shown = {
        images[each["image_id"]]["camera"]
        for each in (*coco["annotations"], *coco["background"])
        if (each["frame"], str(each["k"])) == (back["frame"], back["k"])
        and images[each["image_id"]]["split"] == "unlabeled"
    }
    assert "CAM_BACK" in shown
    assert "CAM_FRONT" not in shown
    # A changed formula is computed again from the stored pixels; the camera stays.
    path = work / "curate.toml"
    path.write_text(path.read_text().replace('mean = "geometric"', 'mean = "product"'))
    code, out, err = curate("score", *here)
    assert code == 0, out + err
    stored = Workspace.open(work).database.rows(_select("semantic_prior", "camera"))
    assert {row[0] for row in stored} == {row["camera"] for row in rows}


def test_ground_truth_is_what_any_chosen_camera_sees(nuscenes: Path) -> None:
    """Each object once; with one camera as before."""
    front = NuScenesDataset(nuscenes)
    pair = NuScenesDataset(nuscenes, cameras=["CAM_FRONT", "CAM_BACK"])
    every = NuScenesDataset(nuscenes, cameras="all")
    assert every.cameras == CAMERAS
    for name in front.frame_ids():
        seen = {dataset: dataset.annotations(name) for dataset in (front, pair, every)}
        counts = [len(seen[dataset]) for dataset in (front, pair, every)]
        assert counts[0] < counts[1] <= counts[2] == 4
        assert len(np.unique(seen[every].boxes.round(6), axis=0)) == 4
        same = [np.abs(seen[every].boxes - box).sum(axis=1).argmin() for box in seen[front].boxes]
        np.testing.assert_allclose(seen[every].boxes[same], seen[front].boxes)
        frame = every.read(name, points=False, image=True)
        assert [camera.name for camera in frame.cameras] == list(CAMERAS)
        assert all(camera.image is not None for camera in frame.cameras)
        assert len(every.files(name).images) == 6
        only = front.read(name, image=True)
        assert (only.camera, only.further_cameras) == ("", ())
        np.testing.assert_array_equal(
            only.calibration.lidar_to_image, frame.calibration.lidar_to_image
        )


def test_one_camera_gives_the_same_evidence_as_the_first_of_several(
    nuscenes: Path, tmp_path: Path, curate: Curate
) -> None:
    """Bit by bit, for the labels that it shows; without the column `camera`."""
    results = write_results(tmp_path / "results.json")
    one = scored(curate, tmp_path / "one", nuscenes, results, write_maps(tmp_path / "flat", ("",)))
    several = scored(
        curate, tmp_path / "several", nuscenes, results, write_maps(tmp_path / "maps", CAMERAS),
        "--dataset-option", "cameras=all",
    )  # fmt: skip
    assert "camera" not in one[0]
    same = [(a, b) for a, b in zip(one, several, strict=True) if b["camera"] == "CAM_FRONT"]
    assert same
    for a, b in same:
        assert [a[name] for name in ("mask_pixels", "box_pixels", "rho_anno")] == [
            b[name] for name in ("mask_pixels", "box_pixels", "rho_anno")
        ]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["cameras=[CAM_FRONT, CAM_TOP]"], "'CAM_TOP': use one of CAM_BACK"),
        (['cameras=["CAM_FRONT", "CAM_FRONT"]'], "'CAM_FRONT' is listed twice"),
        (["cameras=[]"], "use one of CAM_BACK"),
        (["cameras=all", "camera=CAM_BACK"], "both camera and cameras"),
    ],
)
def test_wrong_cameras_are_rejected(
    nuscenes: Path, tmp_path: Path, curate: Curate, options: list[str], message: str
) -> None:
    """At init, with the names that the tables have."""
    options = [option.replace("[CAM_FRONT, CAM_TOP]", '["CAM_FRONT", "CAM_TOP"]') for option in
               options]  # fmt: skip
    arguments = [each for option in options for each in ("--dataset-option", option)]
    code, _, err = curate(
        "init", tmp_path / "work", "--dataset", "nuscenes", "--root", nuscenes, *arguments
    )
    assert code != 0
    assert message in err
    assert not (tmp_path / "work").exists()


def two_cameras(root: Path) -> str:
    """Write a folder with a camera ahead and one that looks back."""
    write_toy_folder(root, 10)
    shutil.copytree(root / "camera", root / "back")
    calibration = toy_calibration()
    turned = calibration.lidar_to_camera @ np.diag([-1.0, -1, 1, 1])
    tables = "".join(
        f'[cameras.{name}]\nimages = "{images}"\n[cameras.{name}.calibration]\n'
        f"projection = {calibration.projection.tolist()}\nlidar_to_camera = {extrinsic.tolist()}\n"
        for name, images, extrinsic in (
            ("front", "camera", calibration.lidar_to_camera), ("rear", "back", turned),
        )
    )  # fmt: skip
    head = 'points = "lidar"\nlabels = "boxes"\nintensity_scale = 255\n'
    (root / "dataset.toml").write_text(head + tables)
    return head + tables


def mirrored(path: Path, root: Path, *, copies: int = 1) -> Path:
    """Write recorded detections at the labels of a folder, each with a copy behind the car."""
    from curate.datasets.folder import FolderDataset

    dataset = FolderDataset(root)
    names = ("frame", "view", "flip_y", "rotation_rad", "scale", "category", "score", "merged",
             "x", "y", "z", "length", "width", "height", "yaw")  # fmt: skip
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(names)
        for frame in dataset.frame_ids():
            truth = dataset.annotations(frame)
            for view in (0, 1):
                for box, category in zip(truth.boxes, truth.categories, strict=True):
                    for sign in (1, -1)[: 1 + copies]:
                        moved = [sign * box[0], *box[1:]]
                        table.writerow([frame, view, 0, 0.0, 1.0, category, 0.9, 1, *moved])
    return path


def test_a_folder_with_two_cameras(tmp_path: Path, weights_file: Path, curate: Curate) -> None:
    """Maps are in a folder per camera; labels behind the car have image evidence."""
    root, work = tmp_path / "data", tmp_path / "work"
    two_cameras(root)
    record = mirrored(tmp_path / "record.csv", root)
    maps = tmp_path / "maps"
    for camera, class_id in (("front", 1), ("rear", 0)):
        (maps / camera).mkdir(parents=True)
        for i in range(10):
            pixels = np.full((40, 120), class_id, np.uint8)
            cv2.imwrite(str(maps / camera / f"{i:06d}.png"), pixels)
    rows = behind_the_car(curate, work, root, record, maps)
    assert {row["camera"] for row in rows if float(row["x"]) > 0} == {"front"}
    assert {row["camera"] for row in rows if float(row["x"]) < 0} == {"rear"}
    cars = [row for row in rows if row["category"] == "Car"]
    assert all(float(row["rho_anno"]) == 0 for row in cars if float(row["x"]) < 0)
    assert all(float(row["rho_anno"]) > 0.9 for row in cars if float(row["x"]) > 0)


def test_check_compares_the_images_of_every_camera(
    tmp_path: Path, weights_file: Path, curate: Curate
) -> None:
    """An image of the second camera that is in two splits is found."""
    root, work = tmp_path / "data", tmp_path / "work"
    two_cameras(root)
    rng = np.random.default_rng(0)
    for path in (root / "back").iterdir():
        cv2.imwrite(str(path), rng.integers(0, 256, (40, 120, 3), np.uint8))
    (tmp_path / "labeled.txt").write_text("000000\n")
    code, _, err = curate(
        "init", work, "--dataset", "folder", "--root", root, "--val", "0",
        "--labeled", tmp_path / "labeled.txt",
        "--detector", "support.toys:ToyDetector", "--detector-path", weights_file,
    )  # fmt: skip
    assert code == 0, err
    code, out, err = curate("check", "--workspace", work)
    assert code == 0, err
    assert "30 point files and images differ" in out
    shutil.copy(root / "back" / "000000.png", root / "back" / "000007.png")
    code, _, err = curate("check", "--workspace", work)
    assert code == 5
    assert "labeled 000000 and unlabeled 000007 (image)" in err


def behind_the_car(
    curate: Curate, work: Path, root: Path, record: Path, maps: Path, *options: str
) -> list[dict[str, str]]:
    """Weigh recorded labels with saved maps; return the rows of the query."""
    code, _, err = curate(
        "init", work, "--dataset", "folder", "--root", root, "--labeled", "0.3", "--val", "0",
        "--detector", "recorded", "--detector-path", record, *options,
        "--segmenter", "saved", "--segmenter-path", maps, "--segmenter-classes", "simulated",
    )  # fmt: skip
    assert code == 0, err
    for command in ("predict", "repredict", "score", "solve"):
        code, out, err = curate(command, "--workspace", work)
        assert code == 0, f"{command}: {out}{err}"
    code, out, err = curate(
        "query", "SELECT * FROM weighted_labels ORDER BY weight DESC, x DESC", "--csv",
        "--workspace", work,
    )  # fmt: skip
    assert code == 0, err
    return list(csv.DictReader(io.StringIO(out)))


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_labels_that_the_camera_does_not_see_never_lead(
    tmp_path: Path, curate: Curate, share: float
) -> None:
    """Made-up boxes behind the car, also if the camera confirms little of the others."""
    root, work = tmp_path / "data", tmp_path / "work"
    write_toy_folder(root, 10)
    record, maps = mirrored(tmp_path / "record.csv", root), tmp_path / "maps"
    maps.mkdir()
    for i in range(10):
        pixels = np.zeros((40, 120), np.uint8)
        pixels[: round(share * 40)] = 1  # the whole map, or its upper part, shows cars
        cv2.imwrite(str(maps / f"{i:06d}.png"), pixels)
    rows = behind_the_car(
        curate, work, root, record, maps, "--set", 'dataset.categories=["Car"]',
        "--set", 'points.statistic="fixed"', "--set", "points.fixed=1",
    )  # fmt: skip
    seen = [float(row["weight"]) for row in rows if row["box_pixels"] != "0"]
    unseen = [row for row in rows if row["box_pixels"] == "0"]
    assert len(unseen) == len(seen) > 0
    assert max(seen) >= max(float(row["weight"]) for row in unseen)
    here = ("--workspace", work)
    code, out, _ = curate("explain", unseen[0]["frame"], unseen[0]["k"], *here)
    assert code == 0
    assert "no image shows the box" in out
    assert "0.7 s^2" in out
    assert "S/A" not in out
    assert "they differ" not in out
    code, out, _ = curate("doctor", unseen[0]["frame"], *here)
    assert "3 of 6 boxes project outside the image" in out
    assert "suspect" in out
    code, out, _ = curate("report", *here)
    page = next((work / "reports").glob("*.html")).read_text()
    assert f"No camera shows {len(unseen)} of the labels" in page


def test_the_former_rule_is_still_a_setting(tmp_path: Path, curate: Curate) -> None:
    """With `neutral`, explain names it."""
    root, work = tmp_path / "data", tmp_path / "work"
    write_toy_folder(root, 10)
    record, maps = mirrored(tmp_path / "record.csv", root), tmp_path / "maps"
    maps.mkdir()
    for i in range(10):
        cv2.imwrite(str(maps / f"{i:06d}.png"), np.ones((40, 120), np.uint8))
    rows = behind_the_car(
        curate, work, root, record, maps, "--set", "semantic.outside=neutral",
        "--set", 'dataset.categories=["Car"]',
    )  # fmt: skip
    unseen = next(row for row in rows if row["box_pixels"] == "0")
    assert float(unseen["rho_anno"]) == float(unseen["score"])
    _, out, _ = curate("explain", unseen["frame"], unseen["k"], "--workspace", work)
    assert "outside = 'neutral' applies: rho_anno = s with s = 0.9000" in out


@pytest.mark.parametrize("kind", ["coco", "openpcdet", "nuscenes"])
def test_a_format_for_the_trainer_that_cannot_hold_the_labels_is_an_error_at_the_start(
    tmp_path: Path, weights_file: Path, curate: Curate, kind: str
) -> None:
    """At init, and at run if the setting comes later; no frame is worked on."""
    kitti(tmp_path / "data")
    arguments = (
        "--root", tmp_path / "data", "--labeled", "0.3", "--detector", "support.toys:ToyDetector",
        "--detector-path", weights_file, "--set", "train.command=true {labels}",
    )  # fmt: skip
    reason = "this data set has none" if kind == "nuscenes" else "the data set has no"
    code, _, err = curate(
        "init", tmp_path / "a", *arguments, "--set", f"train.labels_format={kind}"
    )
    assert code == 2
    assert "train.labels_format: " in err
    assert reason in err
    assert not (tmp_path / "a").exists()
    assert curate("init", tmp_path / "b", *arguments)[0] == 0
    path = tmp_path / "b" / "curate.toml"
    path.write_text(
        path.read_text().replace('labels_format = "sqlite"', f'labels_format = "{kind}"')
    )
    code, out, err = curate("run", "--workspace", tmp_path / "b")
    assert code == 2
    assert reason in err
    assert "predict" not in out


def test_categories_that_nuscenes_does_not_have_are_an_error_at_the_start(
    nuscenes: Path, tmp_path: Path, curate: Curate
) -> None:
    """If the labels are exported in nuScenes' format for the trainer."""
    results = write_results(tmp_path / "results.json")
    code, _, err = curate(
        "init", tmp_path / "work", "--dataset", "nuscenes", "--root", nuscenes, "--labeled", "0.5",
        "--detector", "recorded", "--detector-path", results,
        "--set", 'dataset.categories=["PKW"]', "--set", 'dataset.rename={car="PKW"}',
        "--set", 'detector.rename={Car="PKW"}', "--set", "train.command=true {labels}",
        "--set", "train.labels_format=nuscenes",
    )  # fmt: skip
    assert code == 2
    assert "category 'PKW' is not in nuScenes' detection task" in err
