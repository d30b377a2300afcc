"""Weighted labels as nuScenes' results."""

import json

import numpy as np
import pytest
from support.exported import (
    BOXES,
    SCORES,
    renamed,
    rows_of,
    toy_frame,
    toy_labels,
    with_rows,
)
from support.nuscenes_scenes import into_map, sample_token, vehicle_pose, write_nuscenes

from curate.datasets.nuscenes import NuScenesDataset
from curate.detectors.recorded import RecordedDetector
from curate.errors import ConfigError
from curate.exporters.nuscenes import NuScenesExporter


@pytest.fixture
def dataset(tmp_path):
    """Return a tiny nuScenes dataset."""
    write_nuscenes(tmp_path / "nuscenes")
    return NuScenesDataset(tmp_path / "nuscenes")


def labels_of(dataset, zero_weight="ignore"):
    """Return the toy labels, of two frames of nuScenes."""
    labels = toy_labels(zero_weight=zero_weight)
    first, second = (sample_token("scene-0061", 0), sample_token("scene-0103", 1))
    names = {"000000": first, "000001": second}
    return renamed(labels, names, lambda name: dataset.read(name, points=False))


def test_boxes_are_in_the_map(dataset, tmp_path):
    """As transformed by scipy; a label of weight 0 is not among the results."""
    assert NuScenesExporter().write(tmp_path / "a.json", labels_of(dataset)) == 3
    document = json.loads((tmp_path / "a.json").read_text())
    name = sample_token("scene-0103", 1)
    assert list(document["results"]) == [name]
    kept, [ignored] = document["results"][name], document["ignored"][name]
    assert [box["detection_name"] for box in kept] == ["car", "car"]
    assert (ignored["detection_name"], ignored["weight"], ignored["k"]) == ("pedestrian", 0, 1)
    expected = into_map(np.array(BOXES), vehicle_pose(1, 1))
    for box in [*kept, ignored]:
        right = expected[box["k"]]
        np.testing.assert_allclose(box["translation"], right["translation"], atol=1e-8)
        np.testing.assert_allclose(box["size"], right["size"])
        same = abs(np.dot(box["rotation"], right["rotation"]))
        assert same == pytest.approx(1, abs=1e-12)
    assert set(document["meta"]) >= {
        "use_camera", "use_lidar", "use_radar", "use_map", "use_external",
    }  # fmt: skip


@pytest.mark.parametrize("zero_weight", ["ignore", "background"])
def test_labels_of_weight_0_are_listed_separately(dataset, tmp_path, zero_weight):
    """As ignored or as background; the other list is empty."""
    NuScenesExporter().write(tmp_path / "a.json", labels_of(dataset, zero_weight))
    document = json.loads((tmp_path / "a.json").read_text())
    assert document["meta"]["zero_weight"] == zero_weight
    listed = {"ignore": "ignored", "background": "background"}
    for meaning, part in listed.items():
        [boxes] = document[part].values()
        assert [box["k"] for box in boxes] == ([1] if meaning == zero_weight else [])


def test_our_results_can_be_read_as_a_record(dataset, tmp_path):
    """The boxes are the same."""
    NuScenesExporter().write(tmp_path / "a.json", labels_of(dataset))
    record = RecordedDetector(tmp_path / "a.json", frame_ids=dataset.frame_ids())
    found = record.predict(dataset.read(sample_token("scene-0103", 1), points=False))
    expected = np.array(BOXES)[[0, 2]]
    np.testing.assert_allclose(found.boxes, expected, atol=1e-9)
    assert found.scores.tolist() == [SCORES[0], SCORES[2]]
    assert found.categories.tolist() == ["Car", "Car"]


def test_another_dataset_is_rejected(tmp_path):
    """It has no map."""
    with pytest.raises(ConfigError, match="need the vehicle's poses"):
        NuScenesExporter().write(tmp_path / "a.json", toy_labels())
    assert toy_frame("000001").calibration.lidar_to_map is None


def test_an_unknown_category_is_rejected(dataset, tmp_path):
    """The devkit would fail on it."""
    labels = labels_of(dataset)
    rows = [row | {"category": "Tram"} for row in rows_of(labels)]
    with pytest.raises(ConfigError, match="category 'Tram' is not in nuScenes'"):
        NuScenesExporter().write(tmp_path / "a.json", with_rows(labels, rows))
