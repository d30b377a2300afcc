"""ONNX models with variations; see `input_cases`. Writing them needs the package onnx."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from curate.detectors.onnx import OnnxDetector
from curate.segmenters.onnx import OnnxSegmenter
from docs.input_cases_clouds import PIXELS, POINTS
from docs.input_frame import BOXES, CLASSES, frame
from docs.input_reader import Case, Reader

_CATEGORIES = tuple(CLASSES)
_BOXES = BOXES.astype(np.float32)
_SCORES = np.array([0.9, 0.5], np.float32)
_LABELS = np.array([0, 1])
_OUTPUTS = {"boxes": _BOXES, "scores": _SCORES, "labels": _LABELS}
_PER_CLASS = np.array([[0.9, 0.25], [0.25, 0.5]], np.float32)
_MAP = np.tile(np.repeat(np.array([0, 3, 1]), 40), (1, 40, 1))
_CLASS_SCORES = np.stack([number == _MAP for number in range(4)], axis=1).astype(np.float32)


def _model(
    outputs: Mapping[str, np.ndarray], shape: tuple[str | int, ...], kind: str = "FLOAT"
) -> bytes:
    """Return a model that returns the same arrays for any input."""
    from onnx import TensorProto, helper, numpy_helper

    nodes, values = [], []
    for name, array in outputs.items():
        value = numpy_helper.from_array(array)
        nodes.append(helper.make_node("Constant", [], [name], value=value))
        values.append(helper.make_tensor_value_info(name, value.data_type, array.shape))
    given = helper.make_tensor_value_info("given", getattr(TensorProto, kind), shape)
    graph = helper.make_graph(nodes, "constant", [given], values)
    opsets = [helper.make_opsetid("", 18)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=9)
    return bytes(model.SerializeToString())


def _detector(
    shape: tuple[str | int, ...] = ("n", 4), kind: str = "FLOAT", **changes: Any
) -> bytes:
    outputs = {name: array for name, array in (_OUTPUTS | changes).items() if array is not None}
    return _model(outputs, shape, kind)


def _renamed(names: Mapping[str, str]) -> bytes:
    return _model({names[key]: array for key, array in _OUTPUTS.items()}, ("n", 4))


def _segmenter(shape: tuple[str | int, ...] = (1, 3, 40, 120), **outputs: np.ndarray) -> bytes:
    return _model(outputs, shape)


def _detect(path: Path, **options: Any) -> Any:
    found = OnnxDetector(path, classes=_CATEGORIES, **options).predict(
        replace(frame(), points=POINTS)
    )
    return found.boxes, found.categories, found.scores


def _segment(path: Path, **options: Any) -> Any:
    return OnnxSegmenter(path, CLASSES, **options).segment(replace(frame(), image=PIXELS)).class_ids


def model_readers() -> tuple[Reader, ...]:
    """Return the readers of ONNX models."""
    whole, wide = _detector(), (1, 3, 40, 120)
    return (
        Reader(
            "Detectors in ONNX",
            "Boxes, scores and labels from the points of a sweep. Settings are those of "
            "`[detector.options]`.",
            "detector.onnx", _detect, whole,
            [
                Case("a batch axis", _detector((1, "n", 4))),
                Case("three columns: x, y, z", _detector(("n", 3))),
                Case("half precision", _detector(kind="FLOAT16")),
                Case("double precision", _detector(kind="DOUBLE")),
                Case("outputs named pred_boxes, pred_scores, pred_labels", _renamed(
                    {key: f"pred_{key}" for key in _OUTPUTS})),
                Case("outputs with other names, found by type and shape", _renamed(
                    {"boxes": "a", "scores": "b", "labels": "c"})),
                Case("scores per class and no labels", _detector(scores=_PER_CLASS, labels=None)),
                Case("9 numbers per box: velocities", _detector(
                    boxes=np.hstack([_BOXES, np.zeros((2, 2), np.float32)]))),
                Case("rows of label -1 and score 0 are padding", _detector(
                    boxes=np.vstack([_BOXES, 0 * _BOXES[:1]]), labels=np.append(_LABELS, -1),
                    scores=np.append(_SCORES, 0 * _SCORES[:1]))),
                Case("scores before the sigmoid", _detector(
                    scores=np.log(_SCORES / (1 - _SCORES)))),
                Case("scores before the sigmoid with `sigmoid = true`", _detector(
                    scores=np.log(_SCORES / (1 - _SCORES))), options={"sigmoid": True}),
                Case("labels that begin at 1", _detector(labels=_LABELS + 1)),
                Case("labels that begin at 1 with `first_label = 1`", _detector(labels=_LABELS + 1),
                     options={"first_label": 1}),
                Case("two outputs that can be the scores", _model(
                    {"boxes": _BOXES, "a": _SCORES, "b": _SCORES, "labels": _LABELS}, ("n", 4))),
                Case("two of them with `outputs`", _model(
                    {"boxes": _BOXES, "a": _SCORES, "b": _SCORES, "labels": _LABELS}, ("n", 4)),
                    options={"outputs": {"scores": "a"}}),
                Case("no boxes", _detector(boxes=None)),
                Case("an input of voxels", _detector((1, 10, 400, 400))),
                Case("the file ends early", whole[:-20]),
                Case("not ONNX", b"PK\x03\x04"),
            ],
        ),
        Reader(
            "Segmenters in ONNX",
            "A map of class ids from an image. Settings are those of `[segmenter.options]`.",
            "segmenter.onnx", _segment, _segmenter(map=_MAP),
            [
                Case("images of any size, channels last", _segmenter((1, "h", "w", 3), map=_MAP)),
                Case("scores per class, classes first", _segmenter(map=_CLASS_SCORES)),
                Case("scores per class, classes last", _segmenter(
                    map=_CLASS_SCORES.transpose(0, 2, 3, 1))),
                Case("half precision of the output", _segmenter(
                    map=_CLASS_SCORES.astype(np.float16))),
                Case("outputs out and aux, as in torchvision", _segmenter(
                    out=_CLASS_SCORES, aux=0 * _CLASS_SCORES)),
                Case("several outputs with other names", _segmenter(
                    a=_CLASS_SCORES, b=0 * _CLASS_SCORES)),
                Case("several outputs with `output`", _segmenter(
                    a=_CLASS_SCORES, b=0 * _CLASS_SCORES), options={"output": "a"}),
                Case("an input that is not an image", _segmenter(("n", 4), map=_MAP)),
                Case("an output of other proportions", _segmenter(map=_MAP[:, :, :20])),
                Case("class ids that are not whole numbers", _segmenter(
                    map=_MAP.astype(np.float32) + np.float32(0.5))),
                Case("the file ends early", _segmenter(wide, map=_MAP)[:-20]),
            ],
        ),
    )  # fmt: skip
