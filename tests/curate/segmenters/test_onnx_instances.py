"""The segmenter of instance models with graphs of a few constants."""

from collections.abc import Mapping

import numpy as np
import onnx
import pytest
from contracts.samples import assert_one_line
from onnx import TensorProto, helper, numpy_helper
from support.toys import toy_calibration

from curate.errors import ConfigError, ModelError
from curate.frames import Frame
from curate.segmenters.classes import class_map
from curate.segmenters.onnx_instances import OnnxInstanceSegmenter
from curate.segmenters.pasting import paste_mask

COCO = class_map("coco")
FROM_0 = class_map("coco-from-0")
WIDTH, HEIGHT = 12, 8
KINDS = {"f": TensorProto.FLOAT, "i": TensorProto.INT64, "b": TensorProto.BOOL}


def constant_model(path, results: Mapping[str, np.ndarray], shape=(1, 3, HEIGHT, WIDTH)):
    """Save a float model that returns the same arrays for every image."""
    outputs = [
        helper.make_tensor_value_info(name, KINDS[values.dtype.kind], [None] * values.ndim)
        for name, values in results.items()
    ]
    nodes = [
        helper.make_node("Constant", [], [name], value=numpy_helper.from_array(values))
        for name, values in results.items()
    ]
    inputs = [helper.make_tensor_value_info("image", TensorProto.FLOAT, list(shape))]
    graph = helper.make_graph(nodes, "toy", inputs, outputs)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.helper.set_model_props(model, {"names": "{0: 'nonsense'}", "imgsz": "[9999999, 1]"})
    onnx.save(model, path)
    return path


def outputs_of(boxes, labels, scores, masks) -> dict[str, np.ndarray]:
    """Return outputs like those of Mask R-CNN."""
    return {
        "boxes": np.array(boxes, np.float32).reshape(-1, 4),
        "labels": np.array(labels, np.int64),
        "scores": np.array(scores, np.float32),
        "masks": np.array(masks, np.float32),
    }


def frame(width=WIDTH, height=HEIGHT) -> Frame:
    """Return a frame with an image and nothing else."""
    image = np.zeros((height, width, 3), np.uint8)
    return Frame("000001", np.zeros((0, 4), np.float32), toy_calibration(), (width, height), image)


def classes_of(path, classes=COCO, *, of=None, **options) -> np.ndarray:
    """Return the class ids of a model."""
    return OnnxInstanceSegmenter(path, classes, **options).segment(of or frame()).class_ids


def rectangle(left, top, right, bottom, value, nothing=0, size=(HEIGHT, WIDTH)) -> np.ndarray:
    """Return a map with one rectangle of a class."""
    found = np.full(size, nothing, np.uint8)
    found[top:bottom, left:right] = value
    return found


def test_a_mask_of_a_box_is_resized_into_it(tmp_path):
    """2 x 2 cells over 4 x 4 pixels: bilinear between the centres of the cells, by hand.

    A pixel's position is (i + 0.5) / 2 - 0.5 cells: -0.25, 0.25, 0.75, 1.25. Along one axis the
    first cell counts 0.75, 0.75, 0.25, 0, the second 0, 0.25, 0.75, 0.75.
    """
    mask = np.array([[1.0, 0], [0, 0]])
    first = np.array([0.75, 0.75, 0.25, 0])
    expected = np.zeros((HEIGHT, WIDTH), np.uint8)
    expected[2:6, 3:7] = 3 * (np.outer(first, first) > 0.5)
    assert (expected > 0).sum() == 4
    path = constant_model(tmp_path / "a.onnx", outputs_of([[3, 2, 7, 6]], [3], [0.9], [mask]))
    np.testing.assert_array_equal(classes_of(path), expected)
    lower = classes_of(path, mask_threshold=0.1)
    np.testing.assert_array_equal(lower[2:6, 3:7] > 0, np.outer(first, first) > 0.1)


@pytest.mark.parametrize("form", [(1, 28, 28), (1, 1, 28, 28)])
@pytest.mark.parametrize("batched", [False, True])
def test_a_box_beyond_the_image_is_clipped(tmp_path, form, batched):
    """For each shape of masks."""
    found = outputs_of([[-6, 4, 6, 20]], [3], [0.9], np.ones(form))
    if batched:
        found = {name: values[None] for name, values in found.items()}
        found["masks"] = found["masks"].reshape(1, 1, 28, 28)
    path = constant_model(tmp_path / "a.onnx", found)
    np.testing.assert_array_equal(classes_of(path), rectangle(0, 4, 6, 8, 3))


@pytest.mark.parametrize("kind", [np.float32, bool, np.int64])
def test_masks_of_the_whole_input(tmp_path, kind):
    """The mask counts, not the box."""
    found = outputs_of([[0, 0, 1, 1]], [1], [0.9], np.zeros((1, 1, HEIGHT, WIDTH)))
    found["masks"][0, 0, 1:3, 5:9] = 1
    found["masks"] = found["masks"].astype(kind)
    path = constant_model(tmp_path / "a.onnx", found)
    np.testing.assert_array_equal(classes_of(path), rectangle(5, 1, 9, 3, 1))


def test_higher_scores_are_on_top_and_other_classes_hide(tmp_path):
    """Low scores are dropped; a truck in front of a car hides it."""
    ones = np.ones((4, 4, 4))
    boxes = [[0, 0, 8, 8], [4, 0, 12, 8], [6, 0, 8, 8], [0, 0, 12, 8]]
    path = constant_model(
        tmp_path / "a.onnx", outputs_of(boxes, [3, 1, 8, 2], [0.6, 0.7, 0.9, 0.4], ones)
    )
    expected = rectangle(0, 0, 4, 8, 3)
    expected[:, 4:12] = 1
    expected[:, 6:8] = 0
    np.testing.assert_array_equal(classes_of(path), expected)


def test_scores_can_follow_the_boxes(tmp_path):
    """As in mmdetection's exports."""
    found = outputs_of([[0, 0, 4, 8]] * 2, [2, 0], [0, 0], np.ones((2, 4, 4)))
    del found["scores"]
    found["boxes"] = np.column_stack([found["boxes"], np.float32([0.9, 0.2])])[None]
    path = constant_model(tmp_path / "a.onnx", found)
    outputs = {"boxes": "boxes", "labels": "labels", "masks": "masks"}
    class_ids = classes_of(path, FROM_0, outputs=outputs)
    # Class 0 is a person, so that a 0 elsewhere is detected.
    np.testing.assert_array_equal(class_ids, rectangle(0, 0, 4, 8, 2, nothing=3))


def test_a_larger_image_is_scaled_with_its_proportions(tmp_path):
    """36 x 12 into 12 x 8: a third, in the upper left corner; boxes become three times as large."""
    path = constant_model(
        tmp_path / "a.onnx", outputs_of([[1, 1, 3, 4]], [3], [0.9], np.ones((1, 4, 4)))
    )
    found = classes_of(path, of=frame(36, 12))
    np.testing.assert_array_equal(found, rectangle(3, 3, 9, 12, 3, size=(12, 36)))
    whole = np.zeros((1, HEIGHT, WIDTH))
    whole[0, :, 6:] = 1
    path = constant_model(tmp_path / "b.onnx", outputs_of([[0, 0, 1, 1]], [3], [0.9], whole))
    found = classes_of(path, of=frame(36, 12))
    np.testing.assert_array_equal(found, rectangle(18, 0, 36, 12, 3, size=(12, 36)))


def test_prototypes_are_combined_and_cropped_to_their_boxes(tmp_path):
    """Two prototypes, left and right half; the same object twice is one after NMS."""
    prototypes = np.full((1, 2, HEIGHT, WIDTH), -5, np.float32)
    prototypes[0, 0, :, :6] = prototypes[0, 1, :, 6:] = 5
    rows = [
        # centre, size, person, bicycle, car, left half, right half
        [5, 4, 6, 4, 0, 0, 0.9, 1, 0],
        [5, 4, 6, 4, 0, 0, 0.8, 0, 1],
        [10, 4, 2, 8, 0.7, 0, 0, 0, 1],
        [2, 1, 2, 2, 0.3, 0, 0, 1, 0],
    ]
    found = {"output0": np.float32(rows).T[None], "output1": prototypes}
    path = constant_model(tmp_path / "a.onnx", found)
    outputs = {"predictions": "output0", "prototypes": "output1"}
    expected = rectangle(2, 2, 6, 6, 2, nothing=3)
    expected[:, 9:11] = 0
    np.testing.assert_array_equal(classes_of(path, FROM_0, outputs=outputs), expected)


@pytest.mark.parametrize("shape", [(3, HEIGHT, WIDTH), ("n", 3, "h", "w"), (1, HEIGHT, WIDTH, 3)])
def test_no_objects_in_any_input_format(tmp_path, shape):
    """An empty output is an empty map."""
    path = constant_model(
        tmp_path / "a.onnx", outputs_of([], [], [], np.zeros((0, 1, 28, 28))), shape
    )
    assert not classes_of(path).any()


GOOD = outputs_of([[0, 0, 4, 4]], [3], [0.9], np.ones((1, 28, 28)))
BAD = {
    "boxes of three numbers": ({"boxes": np.zeros((1, 3), np.float32)}, "returns boxes [1, 3], "),
    "one mask too few": (
        {"masks": np.ones((0, 28, 28), np.float32)},
        "masks [0, 28, 28]; expected",
    ),
    "a mask per class": ({"masks": np.ones((1, 3, 28, 28), np.float32)}, "masks [1, 3, 28, 28]; "),
    "a bare number": ({"boxes": np.float32(1).reshape(())}, "returns boxes [], "),
    "no number": ({"boxes": np.full((1, 4), np.nan, np.float32)}, "NaN, infinite or beyond"),
    "half a label": ({"labels": np.float32([0.5])}, "label 0.5, which is not an integer"),
    "masks without cells": ({"masks": np.ones((1, 0, 28), np.float32)}, "28 x 0 cells"),
    "a mask of no numbers": ({"masks": np.full((1, 28, 28), np.nan, np.float32)}, "contains NaN"),
    "an endless mask": ({"masks": np.ones((1, 1, 9000), np.float32)}, "9000 x 1 cells"),
}


@pytest.mark.parametrize("name", BAD)
def test_other_outputs_are_rejected_in_one_line(tmp_path, name):
    """With the shapes of the outputs."""
    changed, message = BAD[name]
    path = constant_model(tmp_path / "a.onnx", GOOD | changed)
    with pytest.raises(ModelError) as caught:
        classes_of(path)
    assert_one_line(caught.value)
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")


def test_prototypes_that_are_nan_are_rejected(tmp_path):
    """They would leave the object without a single pixel."""
    found = {"predictions": np.full((1, 6, 1), 0.9, np.float32)}
    found["prototypes"] = np.full((1, 1, 4, 4), np.nan, np.float32)
    path = constant_model(tmp_path / "a.onnx", found)
    with pytest.raises(ModelError, match=r"a\.onnx: returns a mask that contains NaN"):
        classes_of(path, {"Car": (0,)}, outputs={name: name for name in found})


def test_wrong_prototypes_are_rejected(tmp_path):
    """No columns are left for the classes."""
    found = {"a": np.zeros((1, 6, 9), np.float32), "b": np.zeros((1, 2, 4, 4), np.float32)}
    path = constant_model(tmp_path / "a.onnx", found)
    with pytest.raises(
        ModelError, match=r"predictions \[1, 6, 9\].*expected predictions \[1, 4 \+"
    ):
        classes_of(path, outputs={"predictions": "a", "prototypes": "b"})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"outputs": {"boxes": "boxes"}},
            "segmenter.options.outputs boxes: declare boxes, labels, masks",
        ),
        (
            {"outputs": dict.fromkeys(GOOD, "b")},
            "has no output b.* are boxes, labels, scores, masks",
        ),
        ({"scaling": "caffe"}, "use one of imagenet, unit, none"),
        ({"minimum_score": 2}, "0 to 1"),
    ],
)
def test_wrong_options_are_reported(tmp_path, options, message):
    """Before the first frame."""
    path = constant_model(tmp_path / "a.onnx", GOOD)
    with pytest.raises(ConfigError, match=message):
        OnnxInstanceSegmenter(path, COCO, **options)


def test_an_empty_box_has_no_pixels():
    """Nor does one outside the image."""
    for box in ((3, 3, 3, 5), (5, 3, 4, 6), (20, 20, 30, 30), (3.6, 3.6, 4.4, 4.4)):
        _, mask = paste_mask(np.ones((4, 4)), box, box, (WIDTH, HEIGHT), 0.5)
        assert mask.size == 0
