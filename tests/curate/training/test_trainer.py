"""Training: it learns, resumes after a kill, and rejects invalid input."""

import logging
import pickle
import sqlite3
from contextlib import closing

import numpy as np
import pytest
import torch
from support.killed import Killed, kill_at

from curate.datasets.kitti.dataset import KittiDataset
from curate.detectors.pillars import PillarDetector
from curate.detectors.pillars.checkpoint import load_checkpoint
from curate.errors import ConfigError, DataError, ModelError
from curate.geometry.overlap import iou_3d
from curate.training.batches import Batches
from curate.training.labels import WeightedLabels
from curate.training.loop import one_cycle
from curate.training.settings import TrainingSettings
from curate.training.snapshot import snapshot_path
from curate.training.trainer import train as train_detector
from curate.warnings_once import NOTES


def quick(tiny, **changes):
    """Return settings of a training of about a second."""
    settings = {"preset": tiny, "steps": 6, "batch_size": 2, "pasted": 1, "snapshot_seconds": 0.0}
    return TrainingSettings(**(settings | changes))


def train(labels, output, settings, **options):
    """Train the pillar detector."""
    return train_detector(PillarDetector, labels, output, settings, **options)


def encoded(labels, settings, step=0):
    """Return the batch of a step as the pillar detector encodes it."""
    student = PillarDetector.new_student(settings.preset, labels.categories)
    return student.encode(Batches(labels, settings)[step], "cpu")


def weights_of(path):
    """Return all tensors of a checkpoint."""
    return load_checkpoint(path).weights


def assert_same_weights(path_a, path_b):
    """Check that two checkpoints are equal to the last bit."""
    a, b = weights_of(path_a), weights_of(path_b)
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name])


def test_a_training_learns_its_frames(make_labels, tiny, toy_kitti, tmp_path):
    """After a few seconds every object of two labeled frames is detected."""
    path = tmp_path / "teacher.safetensors"
    settings = quick(
        tiny, steps=120, learning_rate=1e-2, pasted=0, flip_probability=0.0,
        rotation_limit_rad=0.0, scale_range=(1.0, 1.0), snapshot_seconds=60.0,
    )  # fmt: skip
    report = train(make_labels(labeled=2), path, settings)
    assert report.steps == 120
    assert report.bank == {"Car": 2, "Pedestrian": 2, "Cyclist": 2}
    detector, dataset = PillarDetector(path, minimum_score=0.3), KittiDataset(toy_kitti)
    for frame_id in ("000000", "000001"):
        truth = dataset.annotations(frame_id)
        found = detector.predict(dataset.read(frame_id))
        for box, category in zip(truth.boxes, truth.categories, strict=True):
            away = found.boxes[found.categories == category] - box
            assert np.abs(away[:, :2]).max(axis=1).min() < 0.4, (frame_id, category)
        overlap = iou_3d(found.boxes, truth.boxes).max(axis=1)
        assert np.abs(found.iou - overlap)[overlap > 0.5].max() < 0.4


def test_a_labeled_frame_without_objects_is_all_background(make_labels, tiny, tmp_path):
    """It is used in the batches, and every cell of it is background."""
    labels, settings = make_labels(labeled=2), quick(tiny, pasted=0)
    with closing(sqlite3.connect(labels)) as connection:
        connection.execute("DELETE FROM ground_truth WHERE frame = '000001'")
        connection.commit()
    targets = encoded(WeightedLabels(labels), settings).targets
    empty, full = targets.heatmap.amax(dim=(1, 2, 3)).argsort().tolist()
    assert targets.heatmap[empty].max() == 0
    assert targets.background[empty].min() == 1
    assert targets.heatmap[full].max() == 1
    assert train(labels, tmp_path / "out.safetensors", settings).labeled_frames == 2


def test_statistics_are_recorded_every_few_steps_and_at_the_end(make_labels, tiny, tmp_path):
    """The loss is the sum of its terms, and a killed training keeps its records."""
    labels, settings = make_labels(labeled=2), quick(tiny, statistics_steps=4)
    whole = train(labels, tmp_path / "whole.safetensors", settings)
    by_step = {}
    for each in whole.statistics:
        by_step.setdefault(each.step, {})[each.name] = each.value
    assert list(by_step) == [4, 6]
    for step, numbers in by_step.items():
        terms = numbers["heatmap"] + numbers["box"] + numbers["iou"]
        assert numbers["loss"] == pytest.approx(terms)
        assert numbers["learning_rate"] == one_cycle(step - 1, 6, settings.learning_rate)
        assert numbers["gradient_norm"] > 0
    with pytest.raises(Killed):
        train(labels, tmp_path / "killed.safetensors", settings, progress=kill_at(6))
    resumed = train(labels, tmp_path / "killed.safetensors", settings)
    assert resumed.resumed_at == 5
    assert resumed.statistics == whole.statistics


@pytest.mark.parametrize("teacher", ["student", "ema"])
def test_a_killed_training_ends_with_the_same_weights(make_labels, tiny, tmp_path, teacher, caplog):
    """Killed after step 4 and called again, it resumes there, and says so."""
    caplog.set_level(logging.INFO, logger=NOTES)
    labels, settings = make_labels(labeled=3, unlabeled=2), quick(tiny, teacher=teacher)
    whole, killed = tmp_path / "whole.safetensors", tmp_path / "killed.safetensors"
    whole_report = train(labels, whole, settings)
    with pytest.raises(Killed):
        train(labels, killed, settings, progress=kill_at(5))
    assert not killed.exists()
    assert not caplog.messages
    report = train(labels, killed, settings)
    assert report.resumed_at == 4
    assert caplog.messages == ["killed: the training resumes from step 4 of 6"]
    assert report.loss == whole_report.loss
    assert_same_weights(whole, killed)
    assert not snapshot_path(killed).exists()


@pytest.mark.parametrize("change", ["settings", "labels", "start", "damage", "pickle"])
def test_a_snapshot_of_another_training_is_not_used(make_labels, tiny, tmp_path, change):
    """With other settings, labels or start, or a damaged snapshot, a training starts anew."""
    labels, output = make_labels(labeled=2), tmp_path / "out.safetensors"
    settings, start = quick(tiny), None
    train(labels, tmp_path / "start.safetensors", quick(tiny, steps=1))
    with pytest.raises(Killed):
        train(labels, output, settings, progress=kill_at(4))
    if change == "settings":
        settings = quick(tiny, learning_rate=1e-3)
    elif change == "labels":
        labels = make_labels(labeled=3, name="more.sqlite")
    elif change == "start":
        start = tmp_path / "start.safetensors"
    elif change == "damage":
        snapshot_path(output).write_bytes(snapshot_path(output).read_bytes()[:5000])
    else:
        snapshot_path(output).write_bytes(pickle.dumps({"fingerprint": print}, protocol=2))
    assert train(labels, output, settings, start=start).resumed_at == 0


def test_fine_tuning_starts_from_the_teacher(make_labels, tiny, tmp_path):
    """At a tiny learning rate the student is the teacher, up to the running means of its norms."""
    labels, teacher = make_labels(labeled=2), tmp_path / "teacher.safetensors"
    student = tmp_path / "student.safetensors"
    train(labels, teacher, quick(tiny))
    train(labels, student, quick(tiny, learning_rate=1e-12), start=teacher)
    for name, array in weights_of(teacher).items():
        if "running" not in name and "num_batches" not in name:
            np.testing.assert_allclose(weights_of(student)[name], array, atol=1e-6)


def test_the_average_of_the_student_is_saved(make_labels, tiny, tmp_path):
    """After one step with half of the start kept: the mean of the start and the plain student."""
    labels = make_labels(labeled=2)
    start, student, average = (tmp_path / f"{name}.safetensors" for name in ("start", "one", "ema"))
    train(labels, start, quick(tiny))
    train(labels, student, quick(tiny, steps=1), start=start)
    settings = quick(tiny, steps=1, teacher="ema", ema_decay=0.5**1e-4)
    train(labels, average, settings, start=start)
    for name, array in weights_of(average).items():
        one, other = weights_of(start)[name], weights_of(student)[name]
        expected = other if "num_batches" in name else (one + other) / 2
        np.testing.assert_allclose(array, expected, rtol=1e-4, atol=1e-6)


def test_a_start_that_does_not_fit_is_rejected(make_labels, tiny, tmp_path):
    """A teacher of other categories or of another preset gives a one-line error."""
    teacher = tmp_path / "teacher.safetensors"
    train(make_labels(labeled=2), teacher, quick(tiny, steps=1))
    cars = make_labels(labeled=2, name="cars.sqlite", categories=("Car",))
    with pytest.raises(
        ConfigError, match=r"teacher\.safetensors: has preset tiny and categories Car, Ped"
    ):
        train(cars, tmp_path / "out.safetensors", quick(tiny), start=teacher)
    with pytest.raises(ConfigError, match="the training needs small"):
        train(make_labels(), tmp_path / "out.safetensors", quick("small"), start=teacher)
    teacher.write_bytes(b"no model")
    with pytest.raises(ModelError, match="teacher"):
        train(make_labels(), tmp_path / "out.safetensors", quick(tiny), start=teacher)


def test_the_result_depends_only_on_the_seed(make_labels, tiny, tmp_path):
    """Same seed, same weights, whatever torch's global generator contains."""
    labels = make_labels(labeled=2)
    paths = [tmp_path / f"{name}.safetensors" for name in "abc"]
    for path, seed in zip(paths, (1, 1, 2), strict=True):
        torch.manual_seed(len(str(path)) + seed * 7)
        before = torch.random.get_rng_state()
        train(labels, path, quick(tiny, steps=2, seed=seed))
        assert torch.equal(torch.random.get_rng_state(), before)
    assert_same_weights(paths[0], paths[1])
    name = "answer.weight"
    assert not np.array_equal(weights_of(paths[0])[name], weights_of(paths[2])[name])


def test_unlabeled_frames_are_added_to_the_labeled_ones(make_labels, tiny):
    """Each step sees as many labeled frames with an unlabeled split as without one."""
    settings = quick(tiny, batch_size=2, unlabeled_batch_size=3)
    mixed = Batches(WeightedLabels(make_labels(2, 6)), settings)
    for step in range(5):
        chosen = mixed.frame_indices(step)
        assert [index in mixed.labeled for index in chosen] == [True] * 2 + [False] * 3
    seen = {index for step in range(3) for index in mixed.frame_indices(step)}
    assert seen == set(range(8))
    alone = Batches(WeightedLabels(make_labels(2, name="b.sqlite")), settings)
    assert [index in alone.labeled for index in alone.frame_indices(7)] == [True] * 2


def test_labels_of_weight_zero_can_become_background(make_labels, tiny):
    """`background` drops them, `ignore` masks their regions."""
    files = {
        zero: make_labels(
            labeled=1, unlabeled=1, weight=0.0, name=f"{zero}.sqlite", zero_weight=zero
        )
        for zero in ("ignore", "background")
    }
    blank = {
        zero: encoded(WeightedLabels(path), quick(tiny, pasted=0))
        .targets.background[-1]
        .eq(0)
        .sum()
        for zero, path in files.items()
    }
    assert blank["ignore"] > 0
    assert blank["background"] == 0


def test_frames_that_do_not_fit_into_memory_are_read_again(make_labels, tiny):
    """Without cache the batches are the same."""
    labels = WeightedLabels(make_labels(labeled=3))
    with_room = encoded(labels, quick(tiny), 2)
    without = encoded(labels, quick(tiny, cache_bytes=0), 2)
    assert torch.equal(with_room.features, without.features)
    assert torch.equal(with_room.targets.heatmap, without.targets.heatmap)


def test_a_training_that_diverges_ends_at_once(make_labels, tiny, tmp_path):
    """No checkpoint of useless weights is written."""
    with pytest.raises(ModelError, match=r"the loss of step \d+ is (nan|inf): .*learning_rate"):
        train(make_labels(labeled=2), tmp_path / "out.safetensors", quick(tiny, learning_rate=1e30))
    assert not (tmp_path / "out.safetensors").exists()


def test_training_needs_labeled_frames(make_labels, tiny, tmp_path):
    """A label file with pseudo-labels only is rejected."""
    with pytest.raises(DataError, match="no labeled frame"):
        train(make_labels(0, 2), tmp_path / "out.safetensors", quick(tiny))


def test_a_category_without_ground_truth_gives_a_warning(make_labels, tiny, tmp_path, caplog):
    """The warning contains the category."""
    labels = make_labels(labeled=1, categories=("Car", "Tram"))
    with caplog.at_level(logging.WARNING):
        train(labels, tmp_path / "out.safetensors", quick(tiny, steps=1))
    assert "no labeled Tram" in caplog.text


def test_an_empty_frame_can_be_trained_on(make_labels, tiny, toy_kitti, tmp_path):
    """A sweep without points."""
    labels = make_labels(labeled=1, unlabeled=1)
    (toy_kitti / "training" / "velodyne" / "000001.bin").write_bytes(b"")
    report = train(labels, tmp_path / "out.safetensors", quick(tiny, steps=2))
    assert np.isfinite(report.loss)


def test_the_learning_rate_rises_and_falls():
    """One cycle: a tenth of the peak first, the peak after three tenths, zero at the end."""
    rates = [one_cycle(step, 100, 2.0) for step in range(100)]
    assert rates[0] == pytest.approx(0.2)
    assert max(rates) == rates[30] == pytest.approx(2.0)
    assert rates[99] < 0.01
    assert one_cycle(0, 1, 1.0) > 0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"steps": 0}, "steps is 0"),
        ({"learning_rate": 0.0}, "learning_rate"),
        ({"unlabeled_batch_size": -1}, "unlabeled_batch_size"),
        ({"scale_range": (0.0, 1.0)}, "scale_range"),
        ({"teacher": "perhaps"}, "choose student or ema"),
    ],
)
def test_invalid_settings_are_rejected(wrong, message):
    """Before anything is read."""
    with pytest.raises(ConfigError, match=message):
        TrainingSettings(**wrong)


def test_an_unknown_preset_is_reported_before_anything_is_read(tmp_path):
    """The known presets are listed; the label file does not even exist."""
    with pytest.raises(ConfigError, match="unknown preset 'huge'; choose one of small, kitti"):
        train(tmp_path / "none.sqlite", tmp_path / "out.safetensors", quick("huge"))


def test_an_unknown_device_is_a_configuration_error(make_labels, tiny, tmp_path):
    with pytest.raises(ConfigError, match="cuda:99"):
        train(make_labels(), tmp_path / "out.safetensors", quick(tiny, device="cuda:99"))
