"""ONNX graphs written node by node."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from onnx import ModelProto, ValueInfoProto, checker, helper, numpy_helper

_OPSET = 18  # the first version whose ScatterND takes a maximum
_IR_VERSION = 10
EPSILON = 1e-5
"""Of torch's batch norms."""


class GraphBuilder:
    """Collects nodes and constants; methods take and return names of values.

    Args:
        weights: the state of the network, by the names of its tensors.
    """

    def __init__(self, weights: Mapping[str, np.ndarray]) -> None:
        self._weights = weights
        self._nodes: list = []
        self._constants: list = []

    def node(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """Add an operator with one output."""
        name = f"value{len(self._nodes)}"
        self._nodes.append(helper.make_node(operator, inputs, [name], **attributes))
        return name

    def constant(self, array: np.ndarray) -> str:
        """Add a constant."""
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
        """Return the finished and checked model."""
        graph = helper.make_graph(self._nodes, name, inputs, outputs, self._constants)
        opsets = [helper.make_opsetid("", _OPSET)]
        model = helper.make_model(graph, opset_imports=opsets, ir_version=_IR_VERSION)
        checker.check_model(model, full_check=full_check)
        return model
