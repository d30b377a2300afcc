"""The shipped segmentation model on frames of a seed that was not used for training."""

from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest

import curate.segmenters
from curate.datasets.formats.images import decode_image
from curate.datasets.kitti.dataset import KittiDataset
from curate.segmenters.classes import class_map
from curate.segmenters.onnx import OnnxSegmenter
from curate.simulation import SEMANTIC_CLASSES, SEMANTIC_FOLDER, simulate
from curate.simulation.segmentation import (
    TEST_SEED,
    TRAIN_SEED,
    SegmentationSettings,
    train_segmentation,
)

MODEL = Path(curate.segmenters.__file__).parent / "models" / "simulated.onnx"
FRESH_SEED = 41
# The IoU of the shipped model, rounded down; pedestrians cover few pixels, so theirs is low.
FLOORS = {"Car": 0.75, "Pedestrian": 0.1, "Cyclist": 0.4}


@pytest.fixture(scope="module")
def predictions(tmp_path_factory):
    """Return (ground truth, prediction) of ten new frames."""
    assert FRESH_SEED not in (TRAIN_SEED, TEST_SEED)
    root = tmp_path_factory.mktemp("fresh")
    simulate(root, 10, FRESH_SEED, workers=1)
    dataset = KittiDataset(root)
    segmenter = OnnxSegmenter(MODEL, class_map("simulated"))
    pairs = []
    for frame_id in dataset.frame_ids():
        path = root / "training" / SEMANTIC_FOLDER / f"{frame_id}.png"
        predicted = segmenter.segment(dataset.read(frame_id, image=True)).class_ids
        pairs.append((decode_image(path, cv2.IMREAD_UNCHANGED), predicted))
    return pairs


@pytest.mark.parametrize(("category", "floor"), FLOORS.items())
def test_it_finds_most_of_each_class(predictions, category, floor):
    """The IoU over all pixels of the new frames is above the minimum."""
    class_id = SEMANTIC_CLASSES[category]
    common = sum(np.sum((truth == class_id) & (found == class_id)) for truth, found in predictions)
    union = sum(np.sum((truth == class_id) | (found == class_id)) for truth, found in predictions)
    assert common / union > floor


def test_it_makes_errors(predictions):
    """The pipeline must work with errors: some frames have wrong pixels of objects."""
    assert any((truth != found)[truth > 0].mean() > 0.02 for truth, found in predictions)


def test_it_is_small_and_has_the_documented_input_and_output():
    """Below one megabyte; uint8 RGB in, uint8 class ids out, of a fixed size."""
    assert MODEL.stat().st_size < 1_000_000
    session = onnxruntime.InferenceSession(str(MODEL), providers=["CPUExecutionProvider"])
    (image,), (predicted,) = session.get_inputs(), session.get_outputs()
    assert (image.type, image.shape) == ("tensor(uint8)", [1, 188, 621, 3])
    assert (predicted.type, predicted.shape) == ("tensor(uint8)", [1, 188, 621])


def test_the_training_script_writes_such_a_model(tmp_path):
    """Two steps on two frames give a model that runs.

    Its scores are in [0, 1], NaN without pixels.
    """
    settings = SegmentationSettings(frames=2, test_frames=1, steps=2, batch_size=1, threads=1)
    scores = train_segmentation(tmp_path / "tiny.onnx", settings)
    assert set(scores) == {"background", *SEMANTIC_CLASSES}
    assert all(np.isnan(score) or 0 <= score <= 1 for score in scores.values())
    session = onnxruntime.InferenceSession(
        str(tmp_path / "tiny.onnx"), providers=["CPUExecutionProvider"]
    )
    predicted = session.run(None, {"image": np.zeros((1, 188, 621, 3), np.uint8)})[0]
    assert predicted.shape == (1, 188, 621)
