"""Weighted labels as ST3D's pseudo-labels."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from support.exported import BOXES, SCORES, WEIGHTS, toy_labels

from curate.errors import DataError
from curate.exporters.st3d import ST3DExporter


def test_pseudo_labels_are_stored_with_their_weights(tmp_path):
    """Of unlabeled frames only; the category counts from 1 and is negative if v = 0."""
    assert ST3DExporter().write(tmp_path / "out", toy_labels()) == 3
    frames = pickle.loads((tmp_path / "out" / "ps_label_e0.pkl").read_bytes())
    assert list(frames) == ["000001"]
    boxes = frames["000001"]["gt_boxes"]
    assert (boxes.shape, boxes.dtype) == ((3, 9), np.float32)
    assert boxes[:, :7] == pytest.approx(np.array(BOXES), abs=1e-5)
    assert boxes[:, 7].tolist() == [1, -2, 1]
    assert boxes[:, 8] == pytest.approx(np.array(SCORES))
    assert frames["000001"]["weight"].tolist() == list(WEIGHTS)
    assert frames["000001"]["memory_counter"].tolist() == [0, 0, 0]
    assert frames["000001"]["cls_scores"] == pytest.approx(np.array(SCORES))


def test_background_is_left_out(tmp_path):
    """ST3D ignores a negative class; dropped labels are background there."""
    assert ST3DExporter().write(tmp_path / "out", toy_labels(zero_weight="background")) == 2
    frame = pickle.loads((tmp_path / "out" / "ps_label_e0.pkl").read_bytes())["000001"]
    assert frame["gt_boxes"][:, 7].tolist() == [1, 1]
    assert frame["weight"].tolist() == [WEIGHTS[0], WEIGHTS[2]]
    assert len(frame["cls_scores"]) == len(frame["memory_counter"]) == 2


def test_a_category_without_a_number_is_rejected(tmp_path):
    """The error contains the frame and the configured categories."""
    labels = toy_labels()
    fewer = replace(labels, description=replace(labels.description, categories=("Car",)))
    with pytest.raises(DataError, match="frame 000001: category 'Pedestrian' is not in"):
        ST3DExporter().write(tmp_path / "out", fewer)
    assert list(tmp_path.iterdir()) == []
