"""The reader of exported labels."""

import sqlite3
from contextlib import closing

import numpy as np
import pytest
import torch

from curate.datasets.kitti.dataset import KittiDataset
from curate.errors import DataError, LeakageError
from curate.frames import Frame
from curate.training.augmentation import Augmentation
from curate.training.labels import WeightedLabels
from curate.training.object_bank import ObjectBank, paste_objects


def change(path, statement):
    """Change a label file directly."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(statement)
        connection.commit()


def test_labeled_and_unlabeled_samples(make_labels):
    """Ground truth has weight 1, pseudo-labels the weight of the file, and the split is known."""
    labels = WeightedLabels(make_labels(labeled=2, unlabeled=1, weight=0.25))
    assert isinstance(labels, torch.utils.data.Dataset)
    assert len(labels) == 3
    assert [sample.labeled for sample in labels] == labels.labeled.tolist() == [True, True, False]
    assert labels.categories == ("Car", "Pedestrian", "Cyclist")
    assert labels[0].weights.tolist() == [1.0, 1.0, 1.0]
    assert labels[2].weights.tolist() == [0.25, 0.25, 0.25]
    assert labels[2].boxes.shape == (3, 7)
    assert sorted(labels[2].categories.tolist()) == ["Car", "Cyclist", "Pedestrian"]
    assert labels[0].points.dtype == np.float32


def test_a_torch_loader_accepts_the_labels(make_labels):
    """The reader works in a user's own training loop."""
    labels = WeightedLabels(make_labels(labeled=2))
    loader = torch.utils.data.DataLoader(labels, batch_size=2, collate_fn=list)
    assert [sample.frame_id for batch in loader for sample in batch] == ["000000", "000001"]


def test_only_points_in_the_camera_view_are_kept(make_labels):
    """Toy frames have points beside the view, which the detector never sees."""
    labels = WeightedLabels(make_labels(labeled=1))
    points = labels[0].points
    assert len(points) > 0
    assert (np.abs(points[:, 1]) <= points[:, 0] + 1e-3).all()


def test_weight_zero_is_marked_as_ignored(make_labels):
    """If the file says so, a label of weight 0 is a region to leave out."""
    sample = WeightedLabels(make_labels(labeled=1, unlabeled=1, weight=0.0))[1]
    assert sample.ignored.all()
    assert len(sample.boxes) == 3


def test_weight_zero_is_not_ignored_if_it_is_background(make_labels):
    """It is there with its weight; its region is not left out."""
    path = make_labels(labeled=1, unlabeled=1, weight=0.0, zero_weight="background")
    sample = WeightedLabels(path)[1]
    assert not sample.ignored.any()
    assert sample.weights.tolist() == [0.0, 0.0, 0.0]


def test_labels_rejected_by_a_person_are_background_under_every_policy(make_labels):
    """Even if uncertain labels of the policy are ignored."""
    path = make_labels(labeled=1, unlabeled=1, weight=0.0, provenance="human")
    assert WeightedLabels(path)[1].boxes.shape == (0, 7)


def test_another_meaning_of_weight_zero_is_rejected(make_labels):
    """A file that was changed by hand."""
    path = make_labels(labeled=1)
    change(path, "UPDATE meta SET value = 'perhaps' WHERE key = 'zero_weight'")
    with pytest.raises(DataError, match=r"meta\.zero_weight is 'perhaps', expected background or"):
        WeightedLabels(path)


def test_neighbour_categories_are_ignored_and_others_left_out(make_labels):
    """A Van is neither Car nor background, a Tram is left out for a detector of cars."""
    path = make_labels(labeled=1, categories=("Car",))
    change(path, "UPDATE ground_truth SET category = 'Van' WHERE category = 'Pedestrian'")
    sample = WeightedLabels(path)[0]
    assert sample.categories.tolist() == ["Car", "Car"]
    assert sorted(sample.weights.tolist()) == [0.0, 1.0]


def test_a_labeled_frame_without_objects_is_a_sample_too(make_labels):
    """It is all background."""
    path = make_labels(labeled=2)
    change(path, "DELETE FROM ground_truth WHERE frame = '000001'")
    sample = WeightedLabels(path)[1]
    assert sample.labeled
    assert sample.boxes.shape == (0, 7)
    assert sample.weights.shape == sample.categories.shape == (0,)
    assert len(sample.points) > 0


def test_a_user_supplied_reader(make_labels, toy_kitti):
    """Frames of any dataset can be read by a function."""
    path = make_labels(labeled=1)
    reference = KittiDataset(toy_kitti).read("000000")

    def read(frame_id: str) -> Frame:
        return Frame(frame_id, reference.points[:50], reference.calibration, reference.image_size)

    assert len(WeightedLabels(path, read=read)[0].points) <= 50


def test_the_dataset_can_have_moved(make_labels, toy_kitti, tmp_path):
    """A root given by the caller replaces the one in the file."""
    path = make_labels(labeled=1)
    toy_kitti.rename(tmp_path / "moved")
    with pytest.raises(DataError, match="kitti"):
        WeightedLabels(path)
    assert len(WeightedLabels(path, root=tmp_path / "moved")[0].points)


def test_ground_truth_of_unlabeled_frames_is_rejected(make_labels):
    """The error contains the frame, and the file is not read."""
    path = make_labels(labeled=1, unlabeled=1)
    change(path, "UPDATE ground_truth SET frame = '000001' WHERE k = 0")
    with pytest.raises(LeakageError, match="000001"):
        WeightedLabels(path)


def test_files_that_are_not_label_files(tmp_path, make_labels):
    """Missing, not SQLite, without the tables, of another version: a one-line error."""
    with pytest.raises(DataError, match=r"none\.sqlite: no such label file"):
        WeightedLabels(tmp_path / "none.sqlite")
    (tmp_path / "text.sqlite").write_text("round,frame,weight\n" * 100)
    with pytest.raises(DataError, match=r"text\.sqlite: not a label file"):
        WeightedLabels(tmp_path / "text.sqlite")
    (tmp_path / "empty.sqlite").touch()
    with pytest.raises(DataError, match=r"empty\.sqlite: not a label file"):
        WeightedLabels(tmp_path / "empty.sqlite")
    path = make_labels()
    change(path, "UPDATE meta SET value = '7' WHERE key = 'format_version'")
    with pytest.raises(DataError, match="label format '7'"):
        WeightedLabels(path)


def test_a_batch_concatenates_frames(make_labels):
    """Points and boxes have their frame index, categories are numbers, weights are an array."""
    labels = WeightedLabels(make_labels(labeled=1, unlabeled=1, weight=0.25))
    loader = torch.utils.data.DataLoader(labels, batch_size=2, collate_fn=labels.collate)
    [batch] = loader
    first, second = labels[0], labels[1]
    assert batch.frame_ids == (first.frame_id, second.frame_id)
    assert batch.labeled.tolist() == [True, False]
    for number, sample in enumerate((first, second)):
        assert (batch.points[batch.point_frames == number].numpy() == sample.points).all()
        own = batch.box_frames == number
        assert np.allclose(batch.boxes[own].numpy(), sample.boxes)
        names = [labels.categories[index] for index in batch.categories[own].tolist()]
        assert names == sample.categories.tolist()
        assert np.allclose(batch.weights[own].numpy(), sample.weights)
    assert batch.points.dtype == batch.boxes.dtype == batch.weights.dtype == torch.float32
    assert batch.to("cpu").boxes.equal(batch.boxes)


@pytest.mark.parametrize(("zero_weight", "boxes"), [("background", 0), ("ignore", 3)])
def test_weight_zero_in_a_batch_means_ignore(make_labels, zero_weight, boxes):
    """Background labels are left out, like everything without a box."""
    path = make_labels(labeled=1, unlabeled=1, weight=0.0, zero_weight=zero_weight)
    labels = WeightedLabels(path)
    batch = labels.collate([labels[1]])
    assert batch.boxes.shape == (boxes, 7)
    assert batch.weights.tolist() == [0.0] * boxes


def test_a_batch_can_have_no_boxes(make_labels):
    """Frames without objects are background."""
    path = make_labels(labeled=1)
    change(path, "DELETE FROM ground_truth")
    labels = WeightedLabels(str(path))
    batch = labels.collate([labels[0]])
    assert batch.boxes.shape == (0, 7)
    assert len(batch.points) == len(batch.point_frames) > 0


def test_regions_to_ignore_are_added_to_unlabeled_frames(make_labels):
    """Also if weight 0 is background otherwise; regions of other categories are left out."""
    path = make_labels(labeled=1, unlabeled=2, weight=0.0, zero_weight="background")
    box = np.array([[10.0, 0, -1, 4, 2, 1.5, 0.3]])
    regions = {
        name: (np.repeat(box, 2, axis=0), np.array(["Car", "Tram"]))
        for name in ("000000", "000001")
    }
    labeled, unlabeled, other = WeightedLabels(path, regions=regions)
    assert not labeled.ignored.any()
    assert len(labeled.boxes) == len(other.boxes) == 3
    assert unlabeled.boxes[-1].tolist() == box[0].tolist()
    assert unlabeled.ignored.tolist() == [False, False, False, True]
    assert unlabeled.weights.tolist() == [0.0] * 4
    bank = ObjectBank.build([labeled], ("Car", "Pedestrian", "Cyclist"))
    pasted = paste_objects(unlabeled, bank, 3, np.random.default_rng(0))
    assert pasted.ignored.tolist()[:4] == [False, False, False, True]
    assert not pasted.ignored[4:].any()
    augmentation = Augmentation(0.0, 0.0, (1.0, 1.0), 0, 1)
    augmented = augmentation.apply(unlabeled, bank, np.random.default_rng(0))
    assert augmented.boxes == pytest.approx(box)
    assert augmented.ignored.tolist() == [True]
    batch = WeightedLabels(path, regions=regions).collate([unlabeled])
    assert batch.weights.tolist() == [0.0]
