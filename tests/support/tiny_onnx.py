"""A detector as an ONNX graph of a few nodes: boxes around the mean of the points."""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

SIZES = ((3.9, 1.6, 1.5), (0.8, 0.6, 1.8), (1.8, 0.6, 1.7))


def tiny_detector(
    path: Path,
    *,
    boxes_per_category: int = 1,
    names: tuple[str, str, str] = ("boxes", "scores", "labels"),
    shape: tuple[str | int, ...] = ("points", 4),
    rows: np.ndarray | None = None,
    scores: np.ndarray | None = None,
    labels: np.ndarray | None = None,
) -> None:
    """Write the ONNX file.

    Args:
        path: of the .onnx file.
        boxes_per_category: each a metre further along x than the one before.
        names: of the outputs.
        shape: of the input.
        rows: (n, 7) what is added to the mean of the points, sizes and yaw included.
        scores: (n,) or (n, classes).
        labels: (n,); left out if scores are per class.
    """
    sizes = np.repeat(SIZES, boxes_per_category, axis=0)
    count = len(sizes)
    if rows is None:
        rows = np.column_stack([np.arange(count), np.zeros((count, 2)), sizes, np.full(count, 0.3)])
    if scores is None:
        scores = np.linspace(0.9, 0.15, len(rows))
    if labels is None and scores.ndim == 1:
        labels = np.repeat(np.arange(3), boxes_per_category)[: len(rows)]
    constants = {"rows": np.float32(rows), "three": np.array([3]), "zero": np.array([0])}
    constants |= {"axis": np.array([len(shape) - 1]), "pads": np.array([0, 0, 0, 4])}
    constants |= {"mean_of": np.array(list(range(len(shape) - 1)))}
    nodes = [
        helper.make_node("Slice", ["points", "zero", "three", "axis"], ["places"]),
        helper.make_node("ReduceMean", ["places", "mean_of"], ["mean"], keepdims=0),
        helper.make_node("Unsqueeze", ["mean", "zero"], ["row"]),
        helper.make_node("Pad", ["row", "pads"], ["padded"]),
        helper.make_node("Add", ["padded", "rows"], [names[0]]),
        helper.make_node("Identity", ["score_values"], [names[1]]),
    ]
    constants["score_values"] = np.float32(scores)
    outputs = [
        helper.make_tensor_value_info(names[0], TensorProto.FLOAT, rows.shape),
        helper.make_tensor_value_info(names[1], TensorProto.FLOAT, scores.shape),
    ]
    if labels is not None:
        constants["label_values"] = np.int64(labels)
        nodes.append(helper.make_node("Identity", ["label_values"], [names[2]]))
        outputs.append(helper.make_tensor_value_info(names[2], TensorProto.INT64, labels.shape))
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info("points", TensorProto.FLOAT, shape)],
        outputs,
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.save(model, str(path))


def constant_model(
    path: Path,
    outputs: dict[str, np.ndarray],
    *,
    inputs: dict[str, tuple[int, tuple[str | int, ...]]] | None = None,
    free: tuple[str, ...] = (),
) -> None:
    """Write a model that returns the same arrays for any input.

    Args:
        path: of the .onnx file.
        outputs: by name.
        inputs: type and shape by name; points [n, 4] if omitted.
        free: outputs with names instead of numbers for all axes but the last.
    """
    nodes, values = [], []
    for name, array in outputs.items():
        value = numpy_helper.from_array(array)
        nodes.append(helper.make_node("Constant", [], [name], value=value))
        shape = list(array.shape)
        if name in free:
            shape[:-1] = [f"{name}{axis}" for axis in range(array.ndim - 1)]
        values.append(helper.make_tensor_value_info(name, value.data_type, shape))
    taken = inputs or {"points": (TensorProto.FLOAT, ("n", 4))}
    declared = [helper.make_tensor_value_info(name, *kind) for name, kind in taken.items()]
    graph = helper.make_graph(nodes, "constant", declared, values)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.save(model, str(path))
