"""A builder that writes ONNX graphs node by node."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from onnx import ModelProto, ValueInfoProto, checker, helper, numpy_helper

from curate.errors import ModelError
from curate.files.atomic import replace_file

_OPSET = 18  # the first version with a maximum reduction in ScatterND
_IR_VERSION = 10
EPSILON = 1e-5
"""The default epsilon of torch's batch norm layers."""


def write_model(model: ModelProto, path: Path) -> None:
    """Write a model, atomically.

    Raises:
        ModelError: if the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, model.SerializeToString())
    except OSError as error:
        raise ModelError(f"{path}: cannot be written: {error.strerror}") from None


class GraphBuilder:
    """Collects nodes and constants of a graph; methods take and return names of values.

    Args:
        weights: the tensors of the network by name, as in its state dict.
    """

    def __init__(self, weights: Mapping[str, np.ndarray]) -> None:
        self._weights = weights
        self._nodes: list = []
        self._constants: list = []

    def node(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """Add an operator with one output and return the name of the output."""
        name = f"value{len(self._nodes)}"
        self._nodes.append(helper.make_node(operator, inputs, [name], **attributes))
        return name

    def constant(self, array: np.ndarray) -> str:
        """Add a constant and return its name."""
        name = f"constant{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def finish(
        self,
        name: str,
        inputs: Sequence[ValueInfoProto],
        outputs: Sequence[ValueInfoProto],
        *,
        full_check: bool = False,
    ) -> ModelProto:
        """Return the complete model, checked by ONNX."""
        graph = helper.make_graph(self._nodes, name, inputs, outputs, self._constants)
        opsets = [helper.make_opsetid("", _OPSET)]
        model = helper.make_model(graph, opset_imports=opsets, ir_version=_IR_VERSION)
        checker.check_model(model, full_check=full_check)
        return model
