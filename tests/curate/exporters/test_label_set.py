"""Label sets: the input that no exporter accepts."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.exported import block, label, rows_of, toy_labels, truth_block, with_rows

from curate.errors import DataError
from curate.exporters.base import FrameFiles
from curate.exporters.coco import CocoExporter
from curate.exporters.objects import frame_objects


@pytest.mark.parametrize("weight", ["abc", b"\x00\xff", None])
def test_weights_that_are_not_numbers_are_rejected(weight):
    """SQLite stores any value that another program writes into a numeric column."""
    rows = rows_of(toy_labels())
    labels = with_rows(toy_labels(), [*rows[:2], rows[2] | {"weight": weight}])
    with pytest.raises(DataError, match=r"frame 000001: label 2 has weight .*expected a number in"):
        list(labels.blocks())


def test_columns_can_be_arrays_in_any_order():
    """NaN in an array is unknown; exporters get plain values in the order of columns."""
    labels = toy_labels()
    [given] = labels.labels
    arrays = {name: np.array(given[name]) for name in reversed(given)}
    arrays |= {name: np.array(given[name], dtype=np.float64) for name in ("loss", "rho_diff")}
    [found] = replace(labels, labels=[arrays]).blocks()
    assert list(found) == list(labels.column_names)
    assert found == {name: list(given[name]) for name in given}
    assert type(found["k"][0]) is int


@pytest.mark.parametrize(
    "change",
    [
        lambda columns: columns.pop("rho_det"),
        lambda columns: columns.update(colour=columns["k"]),
        lambda columns: columns.update(k=columns["k"][:-1]),
    ],
)
def test_a_block_with_other_columns_is_rejected(change):
    """One is missing, one is undeclared, or one is shorter."""
    [columns] = toy_labels().labels
    change(columns)
    with pytest.raises(DataError, match="a block of labels has the columns round, frame"):
        list(replace(toy_labels(), labels=[columns]).blocks())


def test_a_frame_can_continue_in_the_next_block():
    """Its objects do not depend on the blocks."""
    labels = toy_labels()
    rows = rows_of(labels)
    for parts in ([rows[:1], rows[1:]], [[row] for row in rows], [rows[:2], [], rows[2:]]):
        cut = replace(labels, labels=[block(part) for part in parts])
        for one, other in zip(frame_objects(cut), frame_objects(labels), strict=True):
            np.testing.assert_array_equal(one.detections.boxes, other.detections.boxes)
            np.testing.assert_array_equal(one.weights, other.weights)


def test_labels_not_sorted_by_frame_are_rejected():
    """Otherwise those of a frame would be lost, or all would have to be in memory."""
    names = ("000001", "000002")
    frames = [FrameFiles(name, "unlabeled", "p", "i", "c") for name in names]
    rows = [label("000001"), label("000002"), label("000001", 1)]
    labels = replace(with_rows(toy_labels(), rows), frames=frames, ground_truth=truth_block())
    with pytest.raises(DataError, match="labels of frame 000001 are out of order"):
        list(frame_objects(labels))


def test_the_labels_are_iterated_over_once(tmp_path):
    """Each iteration queries the database for all of them."""
    labels = toy_labels()
    walks = []

    class Counted:
        """Labels that count how often they are iterated over."""

        def __iter__(self):
            walks.append(1)
            return iter(labels.labels)

    CocoExporter().write(tmp_path / "a.json", replace(labels, labels=Counted()))
    assert len(walks) == 1


def test_labels_rejected_by_a_person_are_background_under_every_policy(tmp_path):
    """A policy's uncertain labels are ignored, but a human decision is certain."""
    rows = rows_of(toy_labels())
    rows[0] |= {"provenance": "human", "weight": 0.0}
    labels = with_rows(toy_labels(zero_weight="ignore"), rows)
    _, objects = frame_objects(labels)
    assert objects.ignored.tolist() == [False, True, False]
    assert objects.background.tolist() == [True, False, False]
    CocoExporter().write(tmp_path / "a.json", labels)
    document = json.loads((tmp_path / "a.json").read_text())
    assert [each["k"] for each in document["background"]] == [0]
