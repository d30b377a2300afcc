"""The detector that runs any exported ONNX model."""

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from support.fatal_files import write_overflowing_model
from support.tiny_onnx import constant_model, tiny_detector
from support.toys import toy_calibration

from curate.detections import CATEGORIES
from curate.detectors.onnx import OnnxDetector
from curate.errors import ConfigError, ModelError
from curate.frames import Frame

POINTS = np.array([[9.0, 1, -1, 0.2], [11.0, 3, -1, 0.4]], dtype=np.float32)


def frame(points=POINTS):
    """Return two points around (10, 2, -1)."""
    return Frame("000001", points, toy_calibration(), (120, 40))


def detect(path, options=None, **graph):
    """Return the detections of a tiny model."""
    tiny_detector(path, **graph)
    return OnnxDetector(path, **({"classes": CATEGORIES} | (options or {}))).predict(frame())


def double(points):
    """Preprocess: double the points."""
    return {"points": np.concatenate([points, points])}


def upside_down(outputs):
    """Postprocess: turn the boxes upside down."""
    return {
        "boxes": outputs["boxes"][::-1],
        "scores": outputs["scores"][::-1],
        "labels": outputs["labels"],
    }


def summary_sentences(outputs):
    """Postprocess: return class names."""
    return {**outputs, "labels": np.array(["Car"] * len(outputs["labels"]))}


def between_classes(outputs):
    """Postprocess: return labels that are not integers."""
    return {**outputs, "labels": outputs["labels"][:2] + 0.5} | {
        key: outputs[key][:2] for key in ("boxes", "scores")
    }


def nonsense(_):
    """Return something that is not a mapping."""
    return 3


@pytest.fixture
def path(tmp_path):
    """Return the path for the model."""
    return tmp_path / "model.onnx"


def test_boxes_scores_and_labels_become_detections(path):
    """Sorted by falling score, with class names."""
    found = detect(path)
    assert found.categories.tolist() == ["Car", "Pedestrian", "Cyclist"]
    np.testing.assert_allclose(found.boxes[0], [10, 2, -1, 3.9, 1.6, 1.5, 0.3], atol=1e-5)
    np.testing.assert_allclose(found.scores, [0.9, 0.525, 0.15], atol=1e-6)


@pytest.mark.parametrize(
    ("convention", "row"),
    [
        ({"origin": "bottom"}, [0, 0, -0.75, 3.9, 1.6, 1.5, 0.3]),
        ({"order": "wlh"}, [0, 0, 0, 1.6, 3.9, 1.5, 0.3]),
        ({"order": "hwl", "origin": "bottom"}, [0, 0, -0.75, 1.5, 1.6, 3.9, 0.3]),
        ({"yaw_sign": -1}, [0, 0, 0, 3.9, 1.6, 1.5, -0.3]),
        ({"yaw_axis": "y"}, [0, 0, 0, 3.9, 1.6, 1.5, 0.3 - np.pi / 2]),
        ({"yaw_sign": -1, "yaw_offset_rad": -np.pi}, [0, 0, 0, 3.9, 1.6, 1.5, -0.3 - np.pi]),
        ({"yaw_offset_rad": 2 * np.pi}, [0, 0, 0, 3.9, 1.6, 1.5, 0.3]),
    ],
)  # fmt: skip
def test_declared_conventions_are_converted(path, convention, row):
    """The same car for every convention of the model."""
    found = detect(path, {"convention": convention}, rows=np.array([row]))
    np.testing.assert_allclose(found.boxes, [[10, 2, -1, 3.9, 1.6, 1.5, 0.3]], atol=1e-5)


def test_outputs_are_found_by_name_and_inputs_can_have_a_batch(path):
    """`[1, n, 3]` gets only x, y, z."""
    names = ("bbox", "confidence", "class")
    outputs = {"boxes": "bbox", "scores": "confidence", "labels": "class"}
    found = detect(path, {"outputs": outputs}, names=names, shape=(1, "n", 3))
    assert len(found) == 3


def test_scores_per_class_and_logits(path):
    """The best class of each box; the logistic function if scores are logits."""
    logits = np.array([[0.0, 2.0, -1.0], [-3.0, -4.0, 1.0]])
    rows = np.array([[0, 0, 0, 1, 1, 1, 0.0], [5, 0, 0, 1, 1, 1, 0.0]])
    found = detect(path, {"sigmoid": True}, rows=rows, scores=logits)
    assert found.categories.tolist() == ["Pedestrian", "Cyclist"]
    np.testing.assert_allclose(found.scores, 1 / (1 + np.exp([-2.0, -1.0])), atol=1e-6)


def test_labels_can_start_at_one(path):
    """As in many frameworks."""
    found = detect(path, {"first_label": 1}, labels=np.array([3, 1, 2]))
    assert found.categories.tolist() == ["Cyclist", "Car", "Pedestrian"]


def test_nms_can_be_added_to_an_export(path):
    """The better of two boxes of a category stays; other categories do not change."""
    rows = np.tile([0, 0, 0, 3.9, 1.6, 1.5, 0.0], (3, 1))
    labels = np.array([0, 0, 1])
    assert len(detect(path, rows=rows, labels=labels)) == 3
    assert len(detect(path, {"nms_iou": 0.5}, rows=rows, labels=labels)) == 2
    across = {"nms_iou": 0.5, "nms_across": True}
    assert len(detect(path, across, rows=rows, labels=labels)) == 1


def test_user_supplied_functions_run_before_and_after_the_model(path):
    """Specified as package.module:function."""
    options = {"preprocess": f"{__name__}:double", "postprocess": f"{__name__}:upside_down"}
    found = detect(path, options)
    assert found.categories.tolist() == ["Cyclist", "Pedestrian", "Car"]


@pytest.mark.parametrize(
    ("options", "graph", "error", "message"),
    [
        ({}, {"shape": ("n", 5)}, ModelError, "expected one tensor"),
        ({}, {"shape": (100, 4)}, ModelError, r"the inputs are points .*free n, .*preprocess"),
        ({"points": "sweep"}, {}, ModelError, "there is no input sweep"),
        ({"outputs": {"boxes": "b"}}, {}, ModelError, "labels .*; there is no output b"),
        ({"outputs": {"box": "b"}}, {}, ConfigError, "box: use boxes, scores, labels"),
        ({}, {"scores": np.array([3.0, 2, -1])}, ModelError, "from -1 to 3 are not in"),
        ({}, {"labels": np.array([0, 1, 7])}, ModelError, "labels 0 to 7, but classes Car,"),
        ({}, {"labels": np.array([0, 1])}, ModelError, r"labels \[2\]; expected"),
        (
            {},
            {"scores": np.zeros((3, 0))},
            ModelError,
            r"scores \[3, 0\]; expected .* scores \[n, 3\]",
        ),
        (
            {"postprocess": f"{__name__}:summary_sentences"},
            {},
            ModelError,
            "an output is <U3, expected numbers",
        ),
        ({"postprocess": f"{__name__}:between_classes"}, {}, ModelError, "labels 0.5 to 1.5, but"),
        ({"convention": {"order": "xyz"}}, {}, ConfigError, "order 'xyz': use lwh"),
        ({"convention": {"handed": "left"}}, {}, ConfigError, "unexpected keyword"),
        ({"preprocess": "nowhere:f"}, {}, ConfigError, "'nowhere:f' cannot be imported"),
        ({"preprocess": f"{__name__}:nonsense"}, {}, ModelError, "returned int, expected a dict"),
        ({"preprocess": f"{__name__}:POINTS"}, {}, ConfigError, "is not a function"),
    ],
)
def test_a_model_that_does_not_fit_gives_a_one_line_error(path, options, graph, error, message):
    """With the model, its outputs, and the option to set."""
    with pytest.raises(error, match=message) as caught:
        detect(path, options, **graph)
    assert "\n" not in str(caught.value)


def test_a_sweep_without_points_is_not_passed_to_the_model(path):
    """Many exports fail on it."""
    tiny_detector(path)
    assert len(OnnxDetector(path, classes=CATEGORIES).predict(frame(POINTS[:0]))) == 0


def test_a_failing_model_prints_nothing_itself(path, capfd):
    """ONNX Runtime would log several coloured lines beside the one-line error."""
    points = helper.make_tensor_value_info("points", TensorProto.FLOAT, ["n", 4])
    shape = numpy_helper.from_array(np.int64([10**13, 7]), "shape")
    names = ("boxes", "scores")
    nodes = [helper.make_node("ConstantOfShape", ["shape"], [name]) for name in names]
    outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", 7]) for name in names]
    graph = helper.make_graph(nodes, "giant", [points], outputs, [shape])
    onnx.save(
        helper.make_model(graph, ir_version=9, opset_imports=[helper.make_opsetid("", 18)]), path
    )
    with pytest.raises(ModelError, match="Failed to allocate memory"):
        OnnxDetector(path, classes=CATEGORIES).predict(frame())
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("early", [False, True])
def test_a_model_that_ends_the_process_is_rejected(tmp_path, early):
    """ONNX Runtime divides the lowest integer by -1, which is SIGFPE: while it loads or runs."""
    write_overflowing_model(tmp_path / "a.onnx", early=early)
    with pytest.raises(ModelError, match=r"onnxruntime ends the process \(SIGFPE\)") as caught:
        OnnxDetector(tmp_path / "a.onnx", classes=("Car",)).predict(frame())
    assert str(caught.value).startswith(f"{tmp_path / 'a.onnx'}: ")


ROWS = np.float32([[10, 2, -1, 4, 2, 1.5, 0.3], [20, 2, -1, 1, 1, 2, 0.1]])


def detect_constant(path, outputs, options=None, **graph):
    """Return the detections of a model with constant outputs."""
    constant_model(path, outputs, **graph)
    return OnnxDetector(path, **({"classes": CATEGORIES} | (options or {}))).predict(frame())


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("label_kind", [np.int64, np.int32, np.uint8, np.float32])
@pytest.mark.parametrize(
    ("boxes", "scores", "labels"),
    [((2, 7), (2,), (2,)), ((1, 2, 7), (1, 2), (1, 2)), ((2, 7), (2, 1), (2, 1)),
     ((1, 2, 7), (1, 2, 1), (2,))],
)  # fmt: skip
def test_outputs_of_any_number_type_with_or_without_a_batch_axis(
    path, kind, label_kind, boxes, scores, labels
):
    """As exporters write them."""
    outputs = {
        "boxes": ROWS.astype(kind).reshape(boxes),
        "scores": np.array([0.5, 0.75], kind).reshape(scores),
        "labels": np.array([0, 2], label_kind).reshape(labels),
    }
    found = detect_constant(path, outputs)
    assert found.categories.tolist() == ["Cyclist", "Car"]
    assert found.scores.tolist() == [0.75, 0.5]
    np.testing.assert_allclose(found.boxes, ROWS[::-1], rtol=1e-3)


@pytest.mark.parametrize(
    "names",
    [("pred_boxes", "pred_scores", "pred_labels"), ("bboxes_3d", "scores_3d", "labels_3d"),
     ("output0", "output1", "output2"), ("1042", "1043", "1050")],
)  # fmt: skip
@pytest.mark.parametrize("free", [False, True])
def test_outputs_are_told_apart_by_usual_names_or_by_type_and_shape(path, names, free):
    """Integers are labels, seven columns are boxes; also where the number of boxes is free."""
    arrays = (ROWS, np.float32([0.5, 0.75]), np.int64([0, 2]))
    outputs = dict(zip(names, arrays, strict=True))
    found = detect_constant(path, outputs, free=names if free else ())
    assert found.categories.tolist() == ["Cyclist", "Car"]


def test_outputs_that_could_be_either_are_rejected_with_their_shapes(path):
    """Scores of seven classes look like boxes of seven numbers."""
    outputs = {"a": ROWS, "b": np.full((2, 7), 0.5, np.float32)}
    words = (
        r"the outputs are a tensor.float.\[2, 7\], b tensor.float.\[2, 7\]; several can be boxes"
    )
    with pytest.raises(ModelError, match=words):
        detect_constant(path, outputs)
    options = {"outputs": {"boxes": "a", "scores": "b"}, "classes": list("abcdefg")}
    assert len(detect_constant(path, outputs, options)) == 2


@pytest.mark.parametrize("count", [0, 1, 2])
@pytest.mark.parametrize("batched", [False, True])
def test_scores_per_class_of_any_number_of_boxes(path, count, batched):
    """Scores of one box, [1, classes], are not a batch of scores."""
    scores = np.float32([[0.1, 0.2, 0.6], [0.7, 0.1, 0.1]])[:count]
    rows = ROWS[:count]
    outputs = {
        "boxes": rows[None] if batched else rows,
        "scores": scores[None] if batched else scores,
    }
    found = detect_constant(path, outputs)
    assert found.categories.tolist() == ["Car", "Cyclist"][2 - count :]


def test_one_class_needs_neither_labels_nor_columns(path):
    """The only class is meant."""
    for shape in ((2,), (1, 2), (2, 1)):
        outputs = {"boxes": ROWS, "scores": np.float32([0.5, 0.25]).reshape(shape)}
        found = detect_constant(path, outputs, {"classes": ["Car"]})
        assert found.categories.tolist() == ["Car", "Car"]


def test_rows_that_fill_a_fixed_size_are_dropped(path):
    """Label -1 and no score, as a non-maximum suppression of fixed size writes them."""
    outputs = {
        "boxes": np.vstack([ROWS, np.zeros((3, 7), np.float32)]),
        "scores": np.float32([0.5, 0.75, 0, 0, -1]),
        "labels": np.int64([0, 2, -1, -1, -1]),
    }
    assert len(detect_constant(path, outputs)) == 2
    outputs["scores"][2] = 0.5
    with pytest.raises(ModelError, match="labels -1 to 2, but"):
        detect_constant(path, outputs)


@pytest.mark.parametrize("kind", [TensorProto.FLOAT16, TensorProto.DOUBLE])
def test_models_of_other_precision_get_their_type(path, kind):
    """The points are converted."""
    outputs = {"boxes": ROWS, "scores": np.float32([0.5, 0.75]), "labels": np.int64([0, 2])}
    inputs = {"any_name": (kind, (1, "n", 4))}
    assert len(detect_constant(path, outputs, inputs=inputs)) == 2


def test_a_model_without_boxes_is_rejected_with_its_outputs(path):
    """Six numbers are not a box."""
    words = r"the outputs are a tensor.float.\[2, 6\], .*; there is no output boxes; map boxes"
    with pytest.raises(ModelError, match=words):
        detect_constant(path, {"a": ROWS[:, :6], "b": np.float32([0.5, 0.75])})
