"""The effect of track evidence on real sequences: the figures of docs/evidence.md."""

import csv
import gzip
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from curate.detections import CATEGORIES, Annotations, Detections
from curate.evaluation.reliability import MatchSettings, match_to_ground_truth
from curate.frames import Frame
from curate.geometry.similarity import wrap_angle
from curate.priors.base import SequenceFrame
from curate.priors.tracks import Tracks

pytestmark = [pytest.mark.slow, pytest.mark.kitti]

KITTI = MatchSettings(overlap="3d", minimum_iou={"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5})
BOOTSTRAP = 200
# AUROC with the score alone, and with the tracks.
EXPECTED = {"Car": (0.965, 0.970), "Pedestrian": (0.922, 0.955), "Cyclist": (0.962, 0.979)}

Rows = Sequence[Mapping[str, str]]


def rows_by_frame(path: Path) -> dict[tuple[str, int], list[Mapping[str, str]]]:
    """Return the rows of a table by sequence and frame."""
    found = defaultdict(list)
    with gzip.open(path, "rt", newline="") as file:
        for row in csv.DictReader(file):
            found[row["sequence"], int(row["frame"])].append(row)
    return found


def numbers(rows: Rows, *names: str) -> np.ndarray:
    """Return columns of a table as numbers."""
    return np.array([[float(row[name]) for name in names] for row in rows]).reshape(-1, len(names))


def boxes(rows: Rows) -> np.ndarray:
    """Return the boxes in a LiDAR frame at the camera: x forward, y left, z up."""
    right, down, forward, rotation, height = numbers(rows, "x", "y", "z", "rotation_y", "height").T
    sizes = numbers(rows, "length", "width", "height")
    yaws = wrap_angle(-rotation - np.pi / 2)
    return np.column_stack([forward, -right, height / 2 - down, sizes, yaws])


def categories(rows: Rows) -> np.ndarray:
    return np.array([row["category"] for row in rows], dtype=np.str_)


def labels(rows: Rows) -> Detections:
    """Return detections with scores after the sigmoid."""
    scores = 1 / (1 + np.exp(-numbers(rows, "score_raw")[:, 0]))
    return Detections(boxes(rows), scores, categories(rows))


def truth(rows: Rows) -> Annotations:
    """Return annotations; DontCare regions have no box."""
    names = categories(rows)
    found = boxes(rows)
    found[names == "DontCare"] = np.nan
    edges = numbers(rows, "left", "top", "right", "bottom")
    zeros = np.zeros(len(rows))
    return Annotations(found, names, zeros, zeros.astype(np.int64), zeros, edges)


def unread() -> Frame:
    """Fail the test: track evidence needs no sensor data."""
    raise AssertionError("the frame was read")


@pytest.fixture(scope="module")
def table(kitti_tracking_root: Path) -> dict[str, np.ndarray]:
    """Return the counted labels of all sequences: features, whether each is correct, sequence."""
    found = rows_by_frame(kitti_tracking_root / "detections.csv.gz")
    true = rows_by_frame(kitti_tracking_root / "labels.csv.gz")
    parts = defaultdict(list)
    for sequence in sorted({name for name, _ in found}):
        last = max(number for name, number in (*found, *true) if name == sequence)
        frames = []
        for number in range(last + 1):
            rows = found.get((sequence, number), [])
            frame = labels(rows)
            frames.append(SequenceFrame(f"{sequence}_{number:06d}", frame, unread))
            edges = numbers(rows, "left", "top", "right", "bottom")
            matches = match_to_ground_truth(
                frame, truth(true.get((sequence, number), [])), KITTI, edges
            )
            score = np.clip(frame.scores, 1e-4, 1 - 1e-4)
            parts["score"].append(np.log(score / (1 - score)))
            parts["category"].append(frame.categories)
            parts["correct"].append(matches.correct)
            parts["counted"].append(matches.counted)
            parts["sequence"].append(np.full(len(frame), sequence))
        for evidence in Tracks().score_sequence(frames):
            parts["tracks"].append(np.column_stack(list(evidence.values())).astype(np.float64))
    joined = {name: np.concatenate(values) for name, values in parts.items()}
    return {name: values[joined["counted"]] for name, values in joined.items()}


@pytest.mark.parametrize("category", CATEGORIES)
def test_tracks_rank_labels_better(table, category: str, record_property) -> None:
    """A regression fitted on the other sequences; the figures are those of the documentation."""
    linear_model = pytest.importorskip("sklearn.linear_model")
    pipeline = pytest.importorskip("sklearn.pipeline")
    preprocessing = pytest.importorskip("sklearn.preprocessing")
    auroc = pytest.importorskip("sklearn.metrics").roc_auc_score
    part = {name: values[table["category"] == category] for name, values in table.items()}
    features = {
        "score": part["score"][:, None],
        "tracks": np.column_stack([part["score"], part["tracks"]]),
    }
    predicted = {name: np.zeros(len(part["score"])) for name in features}
    sequences = np.unique(part["sequence"])
    for sequence in sequences:
        held_out = part["sequence"] == sequence
        for name, matrix in features.items():
            model = pipeline.make_pipeline(
                preprocessing.StandardScaler(),
                linear_model.LogisticRegression(C=0.3, max_iter=2000),
            )
            model.fit(matrix[~held_out], part["correct"][~held_out])
            predicted[name][held_out] = model.predict_proba(matrix[held_out])[:, 1]
    found = [float(auroc(part["correct"], values)) for values in predicted.values()]
    assert found == pytest.approx(EXPECTED[category], abs=0.002)
    rng, differences = np.random.default_rng(0), []
    members = [np.flatnonzero(part["sequence"] == sequence) for sequence in sequences]
    for _ in range(BOOTSTRAP):
        drawn = np.concatenate([members[i] for i in rng.integers(len(members), size=len(members))])
        one, other = (auroc(part["correct"][drawn], values[drawn]) for values in predicted.values())
        differences.append(float(other - one))
    record_property("difference", [found[1] - found[0], *np.quantile(differences, [0.025, 0.975])])
    assert np.median(differences) > 0
