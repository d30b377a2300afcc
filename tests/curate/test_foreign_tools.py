"""Readers of other projects accept curate's files; each test is skipped if its project is missing.

Most of their dependencies are not needed: `pip install --no-deps -r .ci/foreign-tools.txt`. Parts
that need a display or CUDA are replaced by stubs.
"""

import importlib.util
import json
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from support.exported import BOXES, renamed, toy_labels
from support.nuscenes_scenes import sample_token, write_nuscenes
from support.reviews import small_sheet
from support.toys import IMAGE_SIZE

from curate.datasets.nuscenes import NuScenesDataset
from curate.exporters.coco import CocoExporter
from curate.exporters.mmdet3d import MMDet3DExporter
from curate.exporters.nuscenes import NuScenesExporter
from curate.frames import Frame
from curate.review.editors.cvat import CvatEditor
from curate.review.editors.labelcloud import LabelCloudEditor
from curate.simulation import open3d_loader


def foreign(name: str):
    """Return a module of another project; skip the test if it cannot be imported."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        pytest.skip(f"{name.partition('.')[0]} is not installed, or not all of it: {error}")


class Stubs:
    """Finds any module of some packages, and creates an empty stub."""

    def __init__(self, *packages: str) -> None:
        self.packages = packages

    def find_spec(self, name: str, path=None, target=None):
        """Find a module for the import system."""
        if name.partition(".")[0] in self.packages:
            return importlib.machinery.ModuleSpec(name, self, is_package=True)
        return None

    def create_module(self, spec):
        """Create a module in which every name exists."""
        return MagicMock(__path__=[], __spec__=spec)

    def exec_module(self, module) -> None:
        """Do nothing."""


@pytest.fixture
def stubbed(monkeypatch):
    """Replace packages for displays, CUDA and plots by stubs."""
    missing: set[str] = {"labelCloud", "nuscenes", "datumaro"}

    def stub(*packages: str) -> None:
        missing.update(packages)
        monkeypatch.setattr(sys, "meta_path", [Stubs(*packages), *sys.meta_path])

    yield stub
    # Modules imported with stubs must not stay for other tests.
    for name in [name for name in sys.modules if name.partition(".")[0] in missing]:
        del sys.modules[name]


def read(name: str) -> Frame:
    """Return a function that reads a toy frame with an image."""
    frame = toy_labels().read(name)
    image = np.zeros((IMAGE_SIZE[1], IMAGE_SIZE[0], 3), dtype=np.uint8)
    return replace(frame, image=image)


def test_pycocotools_opens_the_coco_file(tmp_path, capsys):
    """Every annotation is found by its image, with area and a mask of its box."""
    coco = foreign("pycocotools.coco")
    CocoExporter().write(tmp_path / "a.json", toy_labels())
    opened = coco.COCO(str(tmp_path / "a.json"))
    document = json.loads((tmp_path / "a.json").read_text())
    assert sorted(opened.getImgIds()) == sorted(image["id"] for image in document["images"])
    found = opened.loadAnns(opened.getAnnIds())
    assert len(found) == len(document["annotations"]) > 0
    for one in found:
        assert one["area"] == pytest.approx(one["bbox"][2] * one["bbox"][3])
        assert opened.loadCats(one["category_id"])[0]["name"] in {"Car", "Van", "Pedestrian"}


def test_pycocotools_evaluates_the_coco_file_against_itself(tmp_path, capsys):
    """As detections with their scores: everything that is not ignored is found."""
    coco, evaluation = foreign("pycocotools.coco"), foreign("pycocotools.cocoeval")
    CocoExporter().write(tmp_path / "a.json", toy_labels())
    opened = coco.COCO(str(tmp_path / "a.json"))
    truth = [one for one in opened.dataset["annotations"] if not one.get("iscrowd")]
    names = ("image_id", "category_id", "bbox")
    found = opened.loadRes([{name: one[name] for name in names} | {"score": 1.0} for one in truth])
    coco_eval = evaluation.COCOeval(opened, found, "bbox")
    coco_eval.evaluate()
    coco_eval.accumulate()
    coco_eval.summarize()
    assert coco_eval.stats[0] == pytest.approx(1.0)


def test_the_devkit_of_nuscenes_reads_the_results(tmp_path, stubbed):
    """Its detection class accepts each box of the exported results."""
    stubbed("matplotlib", "sklearn", "PIL", "cachetools", "descartes", "shapely", "tqdm")
    classes = foreign("nuscenes.eval.detection.data_classes")
    common = foreign("nuscenes.eval.common.data_classes")
    write_nuscenes(tmp_path / "nuscenes")
    dataset, labels = NuScenesDataset(tmp_path / "nuscenes"), toy_labels()
    names = {"000000": sample_token("scene-0061", 0), "000001": sample_token("scene-0103", 1)}
    labels = renamed(labels, names, lambda name: dataset.read(name, points=False))
    NuScenesExporter().write(tmp_path / "a.json", labels)
    document = json.loads((tmp_path / "a.json").read_text())
    assert {"use_camera", "use_lidar", "use_radar", "use_map", "use_external"} <= set(
        document["meta"]
    )
    boxes = common.EvalBoxes.deserialize(document["results"], classes.DetectionBox)
    assert boxes.sample_tokens == [names["000001"]]
    assert {box.detection_name for box in boxes.all} == {"car"}


def test_labelcloud_opens_an_exported_review(tmp_path, stubbed, monkeypatch):
    """Its reader gives the boxes, and the file that its writer writes is imported unchanged."""
    stubbed("OpenGL", "PyQt5", "pkg_resources")
    installed = importlib.util.find_spec("labelCloud")
    if installed is None:
        pytest.skip("labelCloud is not installed")
    settings = Path(installed.origin).parent / "resources" / "default_config.ini"
    importlib.import_module("pkg_resources").resource_filename.return_value = settings
    open3d_loader.load()  # labelCloud imports open3d, which may miss a library of the system
    monkeypatch.chdir(tmp_path)
    sheet = small_sheet("labelcloud")
    LabelCloudEditor().write(tmp_path, sheet, read)
    centroid = foreign("labelCloud.io.labels.centroid")
    config = foreign("labelCloud.io.labels.config")
    assert config.LabelConfig().get_classes()
    clouds = foreign("labelCloud.io.pointclouds.numpy").NumpyHandler()
    form = centroid.CentroidFormat(tmp_path / "labels", export_precision=8)
    for shown in sheet.frames:
        path = tmp_path / "pointclouds" / f"{shown.frame}.bin"
        points, _ = clouds.read_point_cloud(path)
        np.testing.assert_array_equal(points, read(shown.frame).points[:, :3])
        boxes = form.import_labels(path)
        assert len(boxes) == len(shown.boxes)
        for box, own in zip(boxes, shown.boxes, strict=True):
            assert box.get_classname() == own.category
            np.testing.assert_allclose(box.get_center(), own.box[:3], atol=1e-5)
            np.testing.assert_allclose(box.get_dimensions(), own.box[3:6], atol=1e-5)
            turn = np.deg2rad(box.get_rotations()[2]) - own.box[6]
            assert abs(np.sin(turn / 2)) < 1e-5
        form.export_labels(boxes, path)
    found = LabelCloudEditor().read(tmp_path, sheet, read)
    for shown in sheet.frames:
        for edited, own in zip(found[shown.frame], shown.boxes, strict=True):
            np.testing.assert_allclose(edited.box[:6], own.box[:6], atol=1e-5)


def test_datumaro_opens_a_review_exported_for_cvat(tmp_path, stubbed):
    """The annotations have its own format, cuboids with position, rotation and scale."""
    stubbed("json_stream", "imagesize", "PIL", "shapely", "tifffile", "pandas", "tqdm", "lxml")
    datumaro = foreign("datumaro.components.annotation")
    base = foreign("datumaro.plugins.data_formats.datumaro.base")
    sheet = small_sheet("cvat")
    CvatEditor().write(tmp_path, sheet, read)
    with zipfile.ZipFile(tmp_path / "annotations.zip") as archive:
        archive.extractall(tmp_path / "opened")
    found = {
        item.id: item
        for item in base.DatumaroBase(str(tmp_path / "opened/annotations/default.json"))
    }
    assert set(found) == {shown.frame for shown in sheet.frames}
    for shown in sheet.frames:
        cuboids = [
            one for one in found[shown.frame].annotations if isinstance(one, datumaro.Cuboid3d)
        ]
        for cuboid, own in zip(cuboids, shown.boxes, strict=True):
            np.testing.assert_allclose(cuboid.position, own.box[:3], atol=0.01)
            np.testing.assert_allclose(cuboid.scale, own.box[3:6], atol=0.01)
            assert cuboid.rotation[2] == pytest.approx(own.box[6], abs=0.01)


def test_the_dataset_class_of_mmdetection3d_reads_the_infos(tmp_path):
    """The base class from its engine finds every frame and its instances."""
    engine = foreign("mmengine.dataset.base_dataset")
    labels = replace(toy_labels(), read=read)
    MMDet3DExporter().write(tmp_path / "a", labels)
    dataset = engine.BaseDataset(
        ann_file="a/kitti_infos_train.pkl",
        data_root=str(tmp_path),
        data_prefix={},
        serialize_data=False,
    )
    assert len(dataset) == 2
    assert set(dataset.metainfo["categories"]) >= {"Car", "Pedestrian", "Cyclist"}
    found = dataset.get_data_info(1)
    assert len(found["instances"]) == len(BOXES)
    assert {"lidar_points", "images", "sample_idx"} <= set(found)
